//! The closing table of a run on the terminal.
use super::StageRecord;
use std::fmt::Write;

/// "4.2 s", "3 min 05 s", "1 h 02 min".
pub fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..=9 => format!("{seconds:.1} s"),
        10..=59 => format!("{whole} s"),
        60..=3599 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole / 60 % 60),
    }
}

/// Seconds per stage with a bar, then (label, value) figures.
pub fn table(stages: &[StageRecord], figures: &[(String, String)]) -> String {
    let mut out = String::new();
    let total: f64 = stages.iter().map(|s| s.seconds).sum();
    let longest = stages.iter().map(|s| s.seconds).fold(1e-9, f64::max);
    let wide =
        stages.iter().map(|s| s.name.chars().count()).chain(figures.iter().map(|f| f.0.chars().count()));
    let wide = wide.max().unwrap_or(0).max("total".len());
    // Writing to a String cannot fail.
    for s in stages {
        let bar = "█".repeat((s.seconds / longest * 24.0).round() as usize);
        let _ = writeln!(out, "  {:<wide$}  {:>12}  {bar}", s.name, duration(s.seconds));
    }
    if !stages.is_empty() {
        let _ = writeln!(out, "  {:<wide$}  {:>12}", "total", duration(total));
    }
    for (label, value) in figures {
        let _ = writeln!(out, "  {label:<wide$}  {value}");
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_readable() {
        let cases = [
            (0.04, "0.0 s"),
            (9.4, "9.4 s"),
            (59.4, "59 s"),
            (59.6, "1 min 00 s"),
            (185.0, "3 min 05 s"),
            (3720.0, "1 h 02 min"),
        ];
        for (s, text) in cases {
            assert_eq!(duration(s), text);
        }
    }

    #[test]
    fn the_table_adds_up() {
        let stage = |name: &str, seconds| StageRecord { name: name.into(), seconds, peak_memory: 0 };
        let t = table(&[stage("photos", 1.0), stage("train", 120.0)], &[("splats".into(), "12,345".into())]);
        assert!(t.contains("2 min 01 s") && t.contains("12,345") && t.lines().count() == 4, "{t}");
    }
}
