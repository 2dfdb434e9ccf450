use super::compared::{close, equal, worst};
use super::*;
use crate::gpu::shaders;
use crate::pass::close::Tolerance;

fn wrong(pass: &'static str, way: Option<Way>) -> Row {
    Row { pass, way, time: Duration::ZERO, outcome: Err("wrong".to_owned()) }
}

/// Also: what it does not run is only what benchmarks run.
#[test]
fn every_pass_is_right_on_the_test_device() {
    let options = Options { cache: None, ..Options::from_env(None) };
    let device = Device::with(&options).unwrap();
    let mut told = |row: &Row| -> Result<()> {
        println!("{:<40} {:?} {:?}", row.pass, row.way, row.outcome);
        assert!(row.outcome.is_ok(), "{}: {:?}", row.pass, row.outcome);
        Ok(())
    };
    let rows = super::run(&device, &options, &mut told).unwrap();
    assert_eq!(rows.len(), CASES.len() + 1);
    let run = device.shaders_run();
    let missing: Vec<&str> = shaders::FAMILIES
        .iter()
        .filter(|f| !f.modules.iter().any(|m| run.contains(m.name)))
        .map(|f| f.name)
        .collect();
    assert_eq!(missing, ["bench_copy", "bench_fma", "count_pairs"]);
}

#[test]
fn a_way_is_switched_off_where_its_replacement_is_right() {
    let sweep = [wrong("radix sort", Some(Way::SweepSort))];
    assert_eq!(wrong_ways(&sweep), BTreeSet::from([Way::SweepSort]));
    assert!(!is_fatal(&sweep[0], &wrong_ways(&sweep)));
    let both = [wrong("radix sort", Some(Way::SweepSort)), wrong("radix sort", Some(Way::ChunkSort))];
    assert!(wrong_ways(&both).is_empty() && is_fatal(&both[0], &wrong_ways(&both)));
    let other = [wrong("Adam", None)];
    assert!(wrong_ways(&other).is_empty() && is_fatal(&other[0], &wrong_ways(&other)));
}

#[test]
fn native_float_atomics_are_switched_off_alone_if_it_goes_without_them() {
    let native = wrong("gradients", Some(Way::FloatAtomics));
    assert_eq!(wrong_ways(std::slice::from_ref(&native)), BTreeSet::from([Way::FloatAtomics]));
    let mut rows = vec![native, wrong("gradients", Some(Way::AtomicGradients))];
    assert_eq!(wrong_ways(&rows), BTreeSet::from([Way::FloatAtomics, Way::AtomicGradients]));
    assert!(rows.iter().all(|r| !is_fatal(r, &wrong_ways(&rows))), "entries are stored");
    rows.push(wrong("gradients", Some(Way::StoredGradients)));
    assert!(wrong_ways(&rows).is_empty() && rows.iter().all(|r| is_fatal(r, &BTreeSet::new())));
}

#[test]
fn it_ends_where_the_caller_says_so() {
    let options = Options { cache: None, ..Options::from_env(None) };
    let device = Device::with(&options).unwrap();
    let mut told = 0;
    let stopped = run(&device, &options, &mut |_| {
        told += 1;
        if told == 2 { Err(crate::Error::Cancelled) } else { Ok(()) }
    });
    assert!(matches!(stopped, Err(crate::Error::Cancelled)) && told == 2);
}

#[test]
fn wrong_results_are_told_apart_from_right_ones() {
    let tolerance =
        Tolerance { relative_l2: 1e-3, absolute: 1e-3, relative: 1e-3, outliers: 0.0, outlier_factor: 1.0 };
    assert!(worst([close("a", &[1.0], &[1.0], &tolerance)]).is_ok());
    assert!(worst([Ok(0.0), close("a", &[1.1], &[1.0], &tolerance)]).unwrap_err().contains("a: "));
    assert!(equal("b", &[1, 2], &[1, 2]).is_ok());
    assert!(equal("b", &[1, 3], &[1, 2]).unwrap_err().contains("element 1 is 3, should be 2"));
    assert!(equal("b", &[1], &[1, 2]).is_err());
}
