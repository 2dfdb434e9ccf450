//! Figures of a benchmark, as a table and as JSON.
use super::measure::{Budget, Quartiles, cores, processor_ms};
use super::model::{PassWork, Roofline};
use crate::gpu::{Device, Program, Recorder};
use crate::{Error, Result, files};
use serde::{Deserialize, Serialize};
use std::fmt::Write;
use std::path::Path;

/// Name and version of the JSON layout; readers refuse others.
const FORMAT: &str = "splatvk-bench 1";

/// Name of the section of steps on colour; others begin with it.
pub const COLOUR: &str = "training step";
/// Row of the whole step.
pub const STEP: &str = "training step";
/// Row that adds up the passes above it.
pub const SUM: &str = "sum of the passes";
/// Passes that a render consists of.
const FORWARD: [&str; 4] = ["projection", "depth sort", "binning", "raster forward"];

/// Everything one run of `splatvk bench` measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct BenchReport {
    /// `splatvk-bench 1`.
    pub format: String,
    /// Version of this program.
    pub program: String,
    /// Where it ran.
    pub device: DeviceRecord,
    /// In the order they were measured.
    pub sections: Vec<Section>,
}

/// The device of a report.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct DeviceRecord {
    /// As the driver reports it.
    pub name: String,
    /// Driver and version.
    pub driver: String,
    /// Vulkan version.
    pub vulkan: String,
    /// A software device.
    pub is_cpu: bool,
    /// Threads.
    pub subgroup_size: u32,
    /// Of the host.
    pub cores: usize,
}

/// Measurements that belong together.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Section {
    /// What was measured; equal names are compared between reports.
    pub name: String,
    /// On what.
    pub workload: String,
    /// Times.
    pub rows: Vec<PassRow>,
    /// Counts and derived figures.
    pub figures: Vec<Figure>,
    /// What the passes are made of, for those who make them faster; not in the plain table.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub commands: Vec<CommandRow>,
}

/// The commands of one name in a pass: a shader, a copy or a fill.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CommandRow {
    /// The pass that they belong to.
    pub pass: String,
    /// Shader, or what is filled or copied.
    pub name: String,
    /// How many.
    pub count: usize,
    /// Milliseconds of all of them, by timestamps on the device.
    pub ms: Quartiles,
}

/// One timed thing.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PassRow {
    /// Pass or part of a step.
    pub name: String,
    /// How it was timed.
    pub clock: Clock,
    /// Milliseconds.
    pub ms: Quartiles,
    /// Bytes that have to move, estimated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bytes: Option<f64>,
    /// Floating-point operations that have to be done, estimated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flops: Option<f64>,
    /// Least milliseconds by the measured roofline.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub floor_ms: Option<f64>,
}

/// What a time is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Clock {
    /// Difference of two timestamps on the device.
    #[default]
    Device,
    /// Of the host, submission and waiting included.
    Wall,
}

impl PassRow {
    /// Bytes, operations and the least milliseconds for them.
    fn set_floor(&mut self, [bytes, flops, ms]: [f64; 3]) {
        (self.bytes, self.flops, self.floor_ms) = (Some(bytes), Some(flops), Some(ms));
    }
}

/// One number.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Figure {
    /// What it counts.
    pub name: String,
    /// Its value.
    pub value: f64,
    /// Empty for a ratio.
    pub unit: String,
}

impl BenchReport {
    /// An empty report of a device.
    pub fn new(device: &Device) -> BenchReport {
        let info = device.info();
        let (major, minor, patch) = info.api_version;
        BenchReport {
            format: FORMAT.to_owned(),
            program: env!("CARGO_PKG_VERSION").to_owned(),
            device: DeviceRecord {
                name: info.name.clone(),
                driver: info.driver.clone(),
                vulkan: format!("{major}.{minor}.{patch}"),
                is_cpu: info.is_cpu,
                subgroup_size: info.subgroup_size,
                cores: cores() as usize,
            },
            sections: Vec::new(),
        }
    }

    /// Reads a report from its JSON file.
    pub fn read(path: &Path) -> Result<BenchReport> {
        let bad = |what: String| Error::input(format!("{}: {what}", path.display()));
        let report: BenchReport = files::read_json(path, "give a file of splatvk bench --json")?;
        if report.format != FORMAT {
            return Err(bad(format!("layout {:?}; this program reads {FORMAT:?}", report.format)));
        }
        Ok(report)
    }

    /// The section of a name.
    pub fn section(&self, name: &str) -> Option<&Section> {
        self.sections.iter().find(|s| s.name == name)
    }

    /// Adds the figures that need two sections: steps with features by the step without.
    pub fn relate(&mut self) {
        let step = |s: &Section| s.row(STEP).map(|r| r.ms.median);
        let Some(base) = self.section(COLOUR).and_then(step) else { return };
        let prefix = format!("{}, ", COLOUR);
        for section in self.sections.iter_mut().filter(|s| s.name.starts_with(&prefix)) {
            if let Some(ms) = step(section) {
                section.figure("step / step on colour alone", ms / base, "");
            }
        }
    }

    /// The plain table.
    pub fn table(&self) -> String {
        let d = &self.device;
        let mut text = format!(
            "{} · {} · Vulkan {} · subgroups of {} · {} host cores · splatvk {}\n",
            d.name, d.driver, d.vulkan, d.subgroup_size, d.cores, self.program
        );
        for section in &self.sections {
            section.print(&mut text);
        }
        text
    }
}

/// The times of timed commands added up by the key of each, in the order of first commands: key,
/// and milliseconds per run.
fn sums_by<K: Copy + PartialEq>(keys: &[K], runs: &[Vec<(String, f64)>]) -> Vec<(K, Vec<f64>)> {
    let mut sums: Vec<(K, Vec<f64>)> = Vec::new();
    for (at, &key) in keys.iter().enumerate() {
        let times = runs.iter().map(|run| run[at].1);
        match sums.iter_mut().find(|s| s.0 == key) {
            Some((_, sum)) => sum.iter_mut().zip(times).for_each(|(s, t)| *s += t),
            None => sums.push((key, times.collect())),
        }
    }
    sums
}

impl Section {
    /// An empty section.
    pub fn new(name: impl Into<String>, workload: impl Into<String>) -> Section {
        Section { name: name.into(), workload: workload.into(), ..Section::default() }
    }

    /// The row of a name.
    pub fn row(&self, name: &str) -> Option<&PassRow> {
        self.rows.iter().find(|r| r.name == name)
    }

    /// The value of a figure.
    pub fn value(&self, name: &str) -> Option<f64> {
        self.figures.iter().find(|f| f.name == name).map(|f| f.value)
    }

    /// Adds a time.
    pub fn time(&mut self, name: impl Into<String>, clock: Clock, ms: Quartiles) {
        self.rows.push(PassRow { name: name.into(), clock, ms, ..PassRow::default() });
    }

    /// Adds a figure, if it is a number: a ratio by nothing is left out.
    pub fn figure(&mut self, name: impl Into<String>, value: f64, unit: &str) {
        if value.is_finite() {
            self.figures.push(Figure { name: name.into(), value, unit: unit.to_owned() });
        }
    }

    /// Runs what `record` records again and again and adds a row per pass; the milliseconds of each
    /// run, all passes.
    pub(super) fn passes(
        &mut self,
        device: &Device,
        record: &dyn Fn() -> Recorder,
        budget: &Budget,
    ) -> Result<Vec<f64>> {
        let program = record().compile()?;
        let timed = budget.repeat(|| Ok(program.run_timed()?))?;
        let passes: Vec<&str> = program.passes().collect();
        let names: Vec<&str> = timed.first().into_iter().flatten().map(|c| c.0.as_str()).collect();
        let commands: Vec<(&str, &str)> = passes.iter().copied().zip(names).collect();
        for ((pass, name), times) in sums_by(&commands, &timed) {
            let count = commands.iter().filter(|c| **c == (pass, name)).count();
            let (pass, name, ms) = (pass.to_owned(), name.to_owned(), Quartiles::of(&times));
            self.commands.push(CommandRow { pass, name, count, ms });
        }
        let first = self.rows.len();
        let sums = sums_by(&passes, &timed);
        for (name, times) in &sums {
            self.time(*name, Clock::Device, Quartiles::of(times));
        }
        // Where the host is the device, the processor time of a pass tells what it takes when
        // nothing else runs.
        if device.info().is_cpu {
            let programs = record().compile_passes()?;
            let runs = budget.repeat(|| {
                let pass = |(name, program): &(&'static str, Program)| {
                    let before = processor_ms();
                    program.run()?;
                    Ok((*name, processor_ms() - before))
                };
                programs.iter().map(pass).collect::<Result<Vec<_>>>()
            })?;
            for row in &mut self.rows[first..] {
                let of_row = |run: &Vec<(&str, f64)>| {
                    run.iter().filter(|p| p.0 == row.name).map(|p| p.1).sum::<f64>() / cores()
                };
                row.ms.processor = Quartiles::of(&runs.iter().map(of_row).collect::<Vec<_>>()).median;
            }
        }
        Ok((0..timed.len()).map(|run| sums.iter().map(|(_, times)| times[run]).sum()).collect())
    }

    /// Fills in bytes, operations and floors of the passes, and of the rows that are made of them.
    pub(super) fn bound(&mut self, work: &PassWork, roofline: &Roofline) {
        let mut sums = [[0.0; 3]; 3];
        for row in self.rows.iter_mut().filter(|r| r.clock == Clock::Device) {
            let Some((bytes, flops)) = work.of(&row.name) else { continue };
            let floor = roofline.floor_ms(bytes, flops);
            row.set_floor([bytes, flops, floor]);
            let backward = row.name.ends_with("backward");
            let forward = FORWARD.contains(&row.name.as_str());
            for (sum, counts) in sums.iter_mut().zip([forward, forward || backward, true]) {
                if counts {
                    sum.iter_mut().zip([bytes, flops, floor]).for_each(|(s, v)| *s += v);
                }
            }
        }
        let composed = ["forward", "forward + backward", STEP];
        for row in &mut self.rows {
            match composed.iter().position(|c| *c == row.name) {
                Some(at) => row.set_floor(sums[at]),
                None if row.name == SUM => row.set_floor(sums[2]),
                None => {}
            }
        }
    }

    fn print(&self, text: &mut String) {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "\n{}: {}", self.name, self.workload);
        if !self.rows.is_empty() {
            let _ = writeln!(
                text,
                "  {:<28} {:>10} {:>19} {:>9} {:>5}  {:<6} {:>9} {:>9} {:>8} {:>8}",
                "", "median ms", "quartiles", "best", "runs", "clock", "cpu ms", "floor ms", "MB", "MFLOP"
            );
        }
        for row in &self.rows {
            let ms = &row.ms;
            let clock = if row.clock == Clock::Device { "device" } else { "wall" };
            let quartiles = format!("{:.3}–{:.3}", ms.lower_quartile, ms.upper_quartile);
            let cpu = if ms.processor > 0.0 { format!("{:.1}", ms.processor) } else { String::new() };
            let floor = row.floor_ms.map_or(String::new(), |f| format!("{f:.3}"));
            let mega = |v: Option<f64>| v.map_or(String::new(), |v| format!("{:.1}", v / 1e6));
            let line = format!(
                "  {:<28} {:>10.3} {quartiles:>19} {:>9.3} {:>5}  {clock:<6} {cpu:>9} {floor:>9} {:>8} {:>8}",
                row.name,
                ms.median,
                ms.best,
                ms.runs,
                mega(row.bytes),
                mega(row.flops)
            );
            let _ = writeln!(text, "{}", line.trim_end());
        }
        for figure in &self.figures {
            let line = format!("  {:<40} {:>12} {}", figure.name, plain(figure.value), figure.unit);
            let _ = writeln!(text, "{}", line.trim_end());
        }
    }
}

/// Whole numbers as they are, others with the digits that mean something.
fn plain(value: f64) -> String {
    if value.fract() == 0.0 && value.abs() < 1e15 {
        format!("{value:.0}")
    } else if value.abs() >= 100.0 {
        format!("{value:.1}")
    } else {
        format!("{value:.3}")
    }
}
