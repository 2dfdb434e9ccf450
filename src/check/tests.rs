use super::compared::{close, equal, worst};
use super::images::planes;
use super::*;
use crate::gpu::{Executor, Op, TestDevice, shaders};
use crate::pass::close::Tolerance;
use glam::Vec4;

fn wrong(pass: &'static str, variant: Option<KernelVariant>) -> Row {
    Row { pass, variant, time: Duration::ZERO, outcome: Err("wrong".to_owned()) }
}

/// All shaders run, except those of benchmarks.
#[test]
fn every_pass_matches_its_reference() {
    let options = Options { cache: None, ..crate::gpu::options(None) };
    let device = Device::open(&options).unwrap();
    let mut report = |row: &Row| -> Result<()> {
        println!("{:<40} {:?} {:?}", row.pass, row.variant, row.outcome);
        assert!(row.outcome.is_ok(), "{}: {:?}", row.pass, row.outcome);
        Ok(())
    };
    let rows = super::run(&device, &options, &mut report).unwrap();
    assert_eq!(rows.len(), cases(true).count());
    let run = device.shaders_run();
    let missing: Vec<&str> = shaders::FAMILIES
        .iter()
        .filter(|f| !f.modules.iter().any(|m| run.contains(m.name)))
        .map(|f| f.name)
        .collect();
    assert_eq!(missing, ["bench_arithmetic", "bench_copy", "bench_fma", "count_pairs"]);
}

#[test]
fn wrong_variant_with_replacement_is_disabled() {
    let sweep = [wrong("radix sort", Some(KernelVariant::SweepSort))];
    assert_eq!(wrong_variants(&sweep), BTreeSet::from([KernelVariant::SweepSort]));
    assert!(!is_fatal(&sweep[0], &wrong_variants(&sweep)));
    let both = [
        wrong("radix sort", Some(KernelVariant::SweepSort)),
        wrong("radix sort", Some(KernelVariant::ChunkSort)),
    ];
    assert!(wrong_variants(&both).is_empty() && is_fatal(&both[0], &wrong_variants(&both)));
    let other = [wrong("Adam", None)];
    assert!(wrong_variants(&other).is_empty() && is_fatal(&other[0], &wrong_variants(&other)));
}

#[test]
fn wrong_float_atomics_are_disabled_alone() {
    let native = wrong("gradients", Some(KernelVariant::FloatAtomics));
    assert_eq!(wrong_variants(std::slice::from_ref(&native)), BTreeSet::from([KernelVariant::FloatAtomics]));
    let mut rows = vec![native, wrong("gradients", Some(KernelVariant::AtomicGradients))];
    assert_eq!(
        wrong_variants(&rows),
        BTreeSet::from([KernelVariant::FloatAtomics, KernelVariant::AtomicGradients])
    );
    assert!(rows.iter().all(|r| !is_fatal(r, &wrong_variants(&rows))), "entries are stored");
    rows.push(wrong("gradients", Some(KernelVariant::StoredGradients)));
    assert!(wrong_variants(&rows).is_empty() && rows.iter().all(|r| is_fatal(r, &BTreeSet::new())));
}

#[test]
fn error_of_report_ends_the_check() {
    let options = Options { cache: None, ..crate::gpu::options(None) };
    let device = Device::open(&options).unwrap();
    let mut reported = 0;
    let stopped = run(&device, &options, &mut |_| {
        reported += 1;
        if reported == 2 { Err(crate::Error::Cancelled) } else { Ok(()) }
    });
    assert!(matches!(stopped, Err(crate::Error::Cancelled)) && reported == 2);
}

#[test]
fn comparisons_detect_wrong_results() {
    let tolerance =
        Tolerance { relative_l2: 1e-3, absolute: 1e-3, relative: 1e-3, outliers: 0.0, outlier_factor: 1.0 };
    assert!(worst([close("a", &[1.0], &[1.0], &tolerance)]).is_ok());
    assert!(worst([Ok(0.0), close("a", &[1.1], &[1.0], &tolerance)]).unwrap_err().contains("a: "));
    assert!(equal("b", &[1, 2], &[1, 2]).is_ok());
    assert!(equal("b", &[1, 3], &[1, 2]).unwrap_err().contains("element 1 is 3, should be 2"));
    assert!(equal("b", &[1], &[1, 2]).is_err());
}

#[test]
fn planes_beyond_near_ties_are_wrong() {
    let reference = [Vec4::new(0.1, 0.0, 0.5, 0.2); 1000];
    let with = |count: usize, change: Vec4| {
        let mut actual = reference;
        actual[..count].iter_mut().for_each(|plane| *plane += change);
        planes(&actual, &reference)
    };
    assert!(with(10, Vec4::X).is_ok());
    assert!(with(20, Vec4::X).unwrap_err().contains("98.0 % are the reference's"));
    assert!(with(1, 0.01 * Vec4::W).unwrap_err().contains("costs differ"));
}

/// An executor that fails every run.
struct Broken;

impl Executor for Broken {
    fn run(&self, _: &[&Op]) -> std::result::Result<(), String> {
        Err("broken".to_owned())
    }
}

#[test]
fn device_is_reopened_without_wrong_variant() {
    let options = Options { cache: None, staging: false, ..crate::gpu::options(None) };
    let device = TestDevice::executed_by(Box::new(Broken), 32, &options).unwrap();
    let mut seen = Vec::new();
    let stopped = run(&device, &options, &mut |row| {
        seen.push((row.variant, row.outcome.is_ok()));
        if seen.len() == 4 { Err(crate::Error::Cancelled) } else { Ok(()) }
    });
    assert!(matches!(stopped, Err(crate::Error::Cancelled)));
    // The passes before the sorts have no replacement; the reopened device has no broken executor.
    let expected = [
        (None, false),
        (None, false),
        (Some(KernelVariant::ChunkSort), false),
        (Some(KernelVariant::SweepSort), true),
    ];
    assert_eq!(seen, expected);
}
