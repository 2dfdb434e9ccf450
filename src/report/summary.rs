//! Closing table of a run on the terminal.
use super::StageRecord;
use std::fmt::Write;

/// Formats a duration: "4.2 s", "3 min 05 s", "1 h 02 min".
pub fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..=9 => format!("{seconds:.1} s"),
        10..=59 => format!("{whole} s"),
        60..=3599 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole / 60 % 60),
    }
}

/// Width of the time line, characters.
const LINE: f64 = 30.0;

/// Table of seconds per stage with a bar on a common time line, then (label, value) figures.
pub fn table(stages: &[StageRecord], total: f64, figures: &[(String, String)]) -> String {
    let mut out = String::new();
    let column = |seconds: f64| (seconds / total.max(1e-9) * LINE).round() as usize;
    let wide =
        stages.iter().map(|s| s.name.chars().count()).chain(figures.iter().map(|f| f.0.chars().count()));
    let wide = wide.max().unwrap_or(0).max("total".len());
    // Writing to a String cannot fail.
    for s in stages {
        let (from, to) = (column(s.start), column(s.start + s.seconds));
        let bar = " ".repeat(from) + &"█".repeat((to - from).max(1));
        let bar = bar.trim_end();
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
    fn duration_formats_readable_times() {
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
    fn table_bars_show_stage_times() {
        let stage =
            |name: &str, start, seconds| StageRecord { name: name.into(), start, seconds, peak_memory: 0 };
        let stages = [stage("photos", 0.0, 60.0), stage("train", 60.0, 60.0), stage("masks", 30.0, 30.0)];
        let t = table(&stages, 121.0, &[("splats".into(), "12,345".into())]);
        assert!(t.contains("2 min 01 s") && t.contains("12,345") && t.lines().count() == 5, "{t}");
        let bar = |line: usize| {
            let line: Vec<char> = t.lines().nth(line).unwrap_or("").chars().collect();
            let first = line.iter().position(|c| *c == '█').unwrap();
            (first, line.iter().filter(|c| **c == '█').count())
        };
        // Photos fill the first half, training the second, masks the second quarter.
        assert_eq!((bar(0).1, bar(1).1, bar(2).1), (15, 15, 8));
        assert_eq!((bar(1).0 - bar(0).0, bar(2).0 - bar(0).0), (15, 7));
    }
}
