//! Benchmark report, as a table and as JSON.
use super::least::Least;
use super::measure::{Budget, Quartiles, cores, processor_ms};
use super::model::{PassWork, Roofline};
use crate::gpu::{Device, Program, Recorder};
use crate::pass::fused_update;
use crate::{Error, Result, files};
use serde::{Deserialize, Serialize};
use std::fmt::Write;
use std::path::Path;

/// Name and version of the JSON layout; readers refuse others.
const FORMAT: &str = "splatvk-bench 1";

/// Name of the section of steps on colour; names of other sections of steps begin with it.
pub const COLOUR: &str = "training step";
/// Row of the whole step.
pub const STEP: &str = "training step";
/// Row of the sum of the passes.
pub const SUM: &str = "sum of the passes";
/// Passes of a render.
const FORWARD: [&str; 4] = ["projection", "depth sort", "binning", "raster forward"];

/// Everything one run of `splatvk bench` measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct BenchReport {
    /// `splatvk-bench 1`.
    pub format: String,
    /// Version of this program.
    pub program: String,
    /// Device of the run.
    pub device: DeviceRecord,
    /// Sections in the order of measurement.
    pub sections: Vec<Section>,
}

/// The device of a report.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct DeviceRecord {
    /// Name from the driver.
    pub name: String,
    /// Driver and version.
    pub driver: String,
    /// Vulkan version.
    pub vulkan: String,
    /// Whether it is a software device.
    pub is_cpu: bool,
    /// Threads of a subgroup.
    pub subgroup_size: u32,
    /// Cores of the host.
    pub cores: usize,
}

/// Measurements that belong together.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Section {
    /// Name; sections of equal names are compared between reports.
    pub name: String,
    /// Workload.
    pub workload: String,
    /// Times.
    pub rows: Vec<PassRow>,
    /// Counts and derived figures.
    pub figures: Vec<Figure>,
    /// Commands of the passes, for optimisation; not in the plain table.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub commands: Vec<CommandRow>,
}

/// The commands of one name in a pass: a shader, a copy or a fill.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CommandRow {
    /// Pass of the commands.
    pub pass: String,
    /// Name of the shader, or of the filled or copied buffer.
    pub name: String,
    /// Number of commands.
    pub count: usize,
    /// Milliseconds of all commands, by timestamps on the device.
    pub ms: Quartiles,
}

/// Time of a pass or of a part of a step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PassRow {
    /// Name of the pass or part.
    pub name: String,
    /// Clock of the times.
    pub clock: Clock,
    /// Milliseconds.
    pub ms: Quartiles,
    /// Least bytes to move, estimated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bytes: Option<f64>,
    /// Least floating-point operations, estimated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flops: Option<f64>,
    /// Least milliseconds by the first model (floor v1), until the next release.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub floor_ms: Option<f64>,
    /// Least work by the second model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub least: Option<Least>,
    /// Least milliseconds by the second model (floor v2).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub floor_v2_ms: Option<f64>,
}

/// Clock of a time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Clock {
    /// Difference of two timestamps on the device.
    #[default]
    Device,
    /// Wall clock of the host, with submission and waiting.
    Wall,
}

impl PassRow {
    /// Sets the least work and milliseconds of both models.
    fn set_floor(&mut self, floor: &Floor) {
        (self.bytes, self.flops) = (Some(floor.bytes), Some(floor.flops));
        (self.floor_ms, self.least) = (Some(floor.v1_ms), Some(floor.least));
        self.floor_v2_ms = Some(floor.v2_ms);
    }
}

/// Least work and milliseconds of a pass by both models, or sums of them.
#[derive(Clone, Copy, Default)]
struct Floor {
    bytes: f64,
    flops: f64,
    v1_ms: f64,
    least: Least,
    v2_ms: f64,
}

impl Floor {
    /// `None` for passes without a model.
    fn of(pass: &str, work: &PassWork, roofline: &Roofline) -> Option<Floor> {
        let ((bytes, flops), least) = (work.of(pass)?, work.least(pass)?);
        let (v1_ms, v2_ms) = (roofline.floor_ms(bytes, flops), roofline.limits.ms(&least));
        Some(Floor { bytes, flops, v1_ms, least, v2_ms })
    }

    fn add(&mut self, other: &Floor) {
        self.bytes += other.bytes;
        self.flops += other.flops;
        self.v1_ms += other.v1_ms;
        self.least = self.least + other.least;
        self.v2_ms += other.v2_ms;
    }
}

/// One number.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Figure {
    /// Name.
    pub name: String,
    /// Value.
    pub value: f64,
    /// Unit; empty for a ratio.
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
        let report: BenchReport = files::read_json(path, "give a file of splatvk bench --json")?;
        if report.format != FORMAT {
            let path = path.display();
            return Err(Error::input(format!(
                "{path}: layout {:?}; this program reads {FORMAT:?}",
                report.format
            )));
        }
        Ok(report)
    }

    /// Section by name.
    pub fn section(&self, name: &str) -> Option<&Section> {
        self.sections.iter().find(|s| s.name == name)
    }

    /// Adds the ratios of steps with features to the step without.
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

/// Sums of timed commands by key, in the order of the first command of a key: (key, milliseconds
/// per run).
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

    /// Row by name.
    pub fn row(&self, name: &str) -> Option<&PassRow> {
        self.rows.iter().find(|r| r.name == name)
    }

    /// Value of a figure by name.
    pub fn value(&self, name: &str) -> Option<f64> {
        self.figures.iter().find(|f| f.name == name).map(|f| f.value)
    }

    /// Adds a time.
    pub fn time(&mut self, name: impl Into<String>, clock: Clock, ms: Quartiles) {
        self.rows.push(PassRow { name: name.into(), clock, ms, ..PassRow::default() });
    }

    /// Adds a figure, if it is finite.
    pub fn figure(&mut self, name: impl Into<String>, value: f64, unit: &str) {
        if value.is_finite() {
            self.figures.push(Figure { name: name.into(), value, unit: unit.to_owned() });
        }
    }

    /// Runs the program of `record` repeatedly and adds a row per pass; returns the milliseconds of
    /// all passes per run.
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
        // On a CPU device, the processor time of a pass is about its time on an idle machine.
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

    /// Sets the floors of the passes, and of the rows that consist of passes.
    pub(super) fn bound(&mut self, work: &PassWork, roofline: &Roofline) {
        let mut sums = [Floor::default(); 3];
        let fused = self.row(fused_update::PASS).is_some();
        let work = PassWork { fused, ..*work };
        if let (true, Some(floor)) = (fused, Floor::of("projection backward", &work, roofline)) {
            // The row "forward + backward" is measured without Adam.
            sums[1] = floor;
        }
        for row in self.rows.iter_mut().filter(|r| r.clock == Clock::Device) {
            let Some(floor) = Floor::of(&row.name, &work, roofline) else { continue };
            row.set_floor(&floor);
            let backward = row.name.ends_with("backward");
            let forward = FORWARD.contains(&row.name.as_str());
            for (sum, counts) in sums.iter_mut().zip([forward, forward || backward, true]) {
                if counts {
                    sum.add(&floor);
                }
            }
        }
        let composed = ["forward", "forward + backward", STEP];
        for row in &mut self.rows {
            match composed.iter().position(|c| *c == row.name) {
                Some(at) => row.set_floor(&sums[at]),
                None if row.name == SUM => row.set_floor(&sums[2]),
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
                "  {:<28} {:>9} {:>19} {:>9}  {:<6} {:>7} {:>8} {:>8} {:>5} {:>7} {:>8}",
                "",
                "median ms",
                "quartiles",
                "best",
                "clock",
                "cpu ms",
                "floor v1",
                "floor v2",
                "×",
                "MB",
                "Mslots"
            );
        }
        for row in &self.rows {
            let ms = &row.ms;
            let clock = if row.clock == Clock::Device { "device" } else { "wall" };
            let quartiles = format!("{:.3}–{:.3}", ms.lower_quartile, ms.upper_quartile);
            let cpu = if ms.processor > 0.0 { format!("{:.1}", ms.processor) } else { String::new() };
            let number =
                |value: Option<f64>, digits: usize| value.map_or(String::new(), |v| format!("{v:.digits$}"));
            let mega = |of: fn(&Least) -> f64| number(row.least.map(|least| of(&least) / 1e6), 1);
            let line = format!(
                "  {:<28} {:>9.3} {quartiles:>19} {:>9.3}  {clock:<6} {cpu:>7} {:>8} {:>8} {:>5} {:>7} {:>8}",
                row.name,
                ms.median,
                ms.best,
                number(row.floor_ms, 3),
                number(row.floor_v2_ms, 3),
                number(row.floor_v2_ms.map(|floor| ms.median / floor), 1),
                mega(|least| least.bytes),
                mega(|least| least.slots),
            );
            let _ = writeln!(text, "{}", line.trim_end());
        }
        for figure in &self.figures {
            let line = format!("  {:<40} {:>12} {}", figure.name, plain(figure.value), figure.unit);
            let _ = writeln!(text, "{}", line.trim_end());
        }
    }
}

/// Formats a whole number without decimals, others with the significant ones.
fn plain(value: f64) -> String {
    if value.fract() == 0.0 && value.abs() < 1e15 {
        format!("{value:.0}")
    } else if value.abs() >= 100.0 {
        format!("{value:.1}")
    } else {
        format!("{value:.3}")
    }
}
