//! Text form of the report.
use super::{EvalReport, SplitSummary};
use std::fmt::Write;

impl EvalReport {
    /// The main figures in a few lines; the JSON has all of them.
    pub fn text(&self) -> String {
        let mut out = String::new();
        let worst = |v: &dyn Fn(&super::PoseScore) -> f64| self.poses.iter().map(v).fold(0.0, f64::max);
        let _ = writeln!(
            out,
            "cameras  {} train views; worst rotation {:.3} degrees, centre {:.2} %, focal {:.2} %; AUC@3 {} @5 {} @30 {}",
            self.poses.len(),
            worst(&|p| p.rotation_degrees),
            100.0 * worst(&|p| p.centre_fraction),
            100.0 * worst(&|p| p.focal_relative),
            percent(self.relative_poses.auc_3),
            percent(self.relative_poses.auc_5),
            percent(self.relative_poses.auc_30),
        );
        for (name, lengths) in [("surface", self.surface_lengths), ("cameras", self.camera_lengths)] {
            if let Some(l) = lengths {
                let (median, p90) = (percent(Some(l.median)), percent(Some(l.p90)));
                let _ =
                    writeln!(out, "lengths  {name}: off by {median} at the median, 90 % by less than {p90}");
            }
        }
        if let Some(degrees) = self.up_degrees {
            let _ = writeln!(out, "up       {degrees:.2} degrees off");
        }
        if let Some((distance, right)) = super::instances::summary(&self.instances) {
            let (phrases, right) = (self.instances.len(), percent(Some(right)));
            let _ = writeln!(
                out,
                "things   right number for {right} of {phrases} phrases; middle off by {distance:.4} at the median"
            );
        }
        let _ = writeln!(
            out,
            "{:<9}{:>8}{:>10}{:>7}{:>11}{:>9}{:>9}{:>8}{:>11}",
            "", "PSNR", "+colours", "SSIM", "depth med", "AbsRel", "d<1.25", "mIoU", "localised"
        );
        let refined = self.refined.as_ref().map(|r| ("refined", &r.summary));
        let splits = ["train", "test", "out"];
        let rows = splits.into_iter().filter_map(|k| Some((k, self.summary.get(k)?)));
        rows.chain(refined).for_each(|(name, summary)| row(&mut out, name, summary));
        if let Some(refined) = &self.refined {
            let kept = refined.views.iter().filter(|v| v.kept).count();
            let _ = writeln!(out, "refined: {kept} of {} held-out cameras moved", refined.views.len());
        }
        let rows = splits.into_iter().filter_map(|k| Some((k, self.summary.get(k)?)));
        let mut rows = rows.filter(|(_, s)| s.psnr_shown.is_some()).peekable();
        if rows.peek().is_some() {
            let _ = writeln!(
                out,
                "{:<9}{:>8}{:>10}{:>12}{:>12}{:>13}{:>10}",
                "shown", "PSNR", "on white", "alpha<0.9", "alpha<0.5", "all, <0.9", "confetti"
            );
            rows.for_each(|(name, summary)| shown_row(&mut out, name, summary));
        }
        out
    }
}

/// Means over what the photos show.
fn shown_row(out: &mut String, name: &str, s: &SplitSummary) {
    let _ = writeln!(
        out,
        "{name:<9}{:>8}{:>10}{:>12}{:>12}{:>13}{:>10}",
        number(s.psnr_shown, 2),
        number(s.psnr_shown_white, 2),
        percent(s.alpha_below_90),
        percent(s.alpha_below_50),
        percent(s.transparent),
        percent(s.confetti),
    );
}

fn row(out: &mut String, name: &str, s: &SplitSummary) {
    let _ = writeln!(
        out,
        "{name:<9}{:>8}{:>10}{:>7}{:>11}{:>9}{:>9}{:>8}{:>11}",
        number(s.psnr, 2),
        number(s.psnr_colour_fit, 2),
        number(s.ssim, 3),
        percent(s.depth_median_relative),
        percent(s.depth_abs_rel),
        percent(s.depth_delta),
        number(s.miou, 3),
        number(s.localisation, 3),
    );
}

fn number(v: Option<f64>, digits: usize) -> String {
    v.map_or_else(|| "-".into(), |v| format!("{v:.digits$}"))
}

fn percent(v: Option<f64>) -> String {
    v.map_or_else(|| "-".into(), |v| format!("{:.2} %", 100.0 * v))
}
