//! Comparison of two reports.
use super::report::BenchReport;
use std::fmt::Write;

/// Table of the medians and figures of both reports, with the ratio B / A.
pub fn table(a: &BenchReport, b: &BenchReport) -> String {
    // Writing to a String cannot fail.
    let mut text = format!("A: {} · {} · splatvk {}\n", a.device.name, a.device.driver, a.program);
    let _ = writeln!(text, "B: {} · {} · splatvk {}", b.device.name, b.device.driver, b.program);
    for section in &a.sections {
        let Some(other) = b.section(&section.name) else { continue };
        let _ = writeln!(text, "\n{}: {}", section.name, section.workload);
        if section.workload != other.workload {
            let _ = writeln!(text, "  B has another workload: {}", other.workload);
        }
        let _ = writeln!(text, "  {:<34} {:>12} {:>12} {:>8}", "", "A", "B", "B / A");
        let rows =
            section.rows.iter().filter_map(|r| Some((&r.name, r.ms.median, other.row(&r.name)?.ms.median)));
        let figures = section.figures.iter().filter_map(|f| Some((&f.name, f.value, other.value(&f.name)?)));
        for (name, x, y) in rows.chain(figures) {
            let ratio = if x == y { 1.0 } else { y / x };
            let _ = writeln!(text, "  {name:<34} {x:>12.3} {y:>12.3} {ratio:>8.3}");
        }
    }
    text
}
