//! Estimate of the time that a run still takes: typical seconds of its stages, scaled by the pace
//! that this run has shown so far.
use crate::progress::{Overall, Progress};
use crate::sync::lock;
use std::sync::Mutex;
use std::time::Instant;

/// Working pixels of one of the photos that the typical seconds are of.
const TYPICAL_PIXELS: f64 = 640.0 * 480.0;
/// Number of these photos.
const TYPICAL_PHOTOS: f64 = 4.0;
/// Training steps that the typical seconds are of.
const TYPICAL_STEPS: f64 = 200.0;
/// Typical seconds that the pace of the machine is at first assumed for. They keep the noise of the
/// first short stages out of the estimate.
const PRIOR: f64 = 5.0;
/// Share of a stage from which only its own pace decides what is left of it.
const OWN_PACE: f64 = 0.25;
/// Typical seconds by which the networks of the language delay the training beside them.
const NETWORKS: f64 = 6.5;

/// A stage of the first lane, for which all later ones wait.
struct Part {
    stage: &'static str,
    /// Typical seconds of the stage alone.
    own: f64,
    /// Seconds by which other work delays it, from its start on with half of the processor.
    beside: f64,
}

impl Part {
    /// Typical seconds.
    fn seconds(&self) -> f64 {
        self.own + self.beside
    }

    /// Share of the time that this share of the steps takes.
    fn time_share(&self, steps: f64) -> f64 {
        let own = steps * self.own;
        (2.0 * own).min(own + self.beside) / self.seconds().max(1e-9)
    }
}

/// Size of the work.
pub(super) struct Work {
    /// Whether the device computes on the CPU.
    pub(super) on_cpu: bool,
    /// Number of photos.
    pub(super) photos: usize,
    /// Number of photos that are larger than their working size.
    pub(super) fine: usize,
    /// Working pixels of all photos.
    pub(super) pixels: usize,
    /// Training steps.
    pub(super) steps: usize,
    /// Whether the scene gets language.
    pub(super) language: bool,
    /// Whether built-in methods do all of the work. The time of networks is not known before.
    pub(super) built_in: bool,
}

/// Stages of a run with their typical seconds: of breakfast on two processor cores (llvmpipe), and
/// on an H200 with 16 (docs/internals/performance.md).
fn parts(work: &Work) -> Vec<Part> {
    let photos = work.photos as f64 / TYPICAL_PHOTOS;
    let pixels = work.pixels as f64 / (TYPICAL_PHOTOS * TYPICAL_PIXELS);
    let steps = work.steps as f64 / TYPICAL_STEPS * pixels / photos.max(1e-9);
    let view_dependence = if work.photos < 4 { 0.0 } else { 1.0 };
    let list = [
        ("photos", 0.1, 0.1, photos),
        ("features", 0.3, 0.1, photos),
        // Each photo is adjusted with those before it; positions are found again on fine photos.
        ("cameras", 3.0, 2.5, photos.powf(1.5) + 2.0 * work.fine as f64 / TYPICAL_PHOTOS),
        ("dense stereo", 8.6, 0.3, pixels),
        ("surfaces", 2.1, 1.1, pixels),
        ("initial splats", 1.6, 0.4, pixels),
        ("splats", 16.8, 0.3, steps),
        // Half of the time on photos of shiny things; matt ones skip it.
        ("view dependence", 1.0, 0.2, pixels * view_dependence),
        ("language", 0.7, 0.4, pixels),
        ("decode", 0.7, 0.3, pixels),
        ("query", 0.1, 0.2, 1.0),
        ("seen", 0.3, 0.1, pixels),
        ("write", 0.6, 0.3, pixels),
    ];
    let of_language = |stage: &str| ["language", "decode", "query"].contains(&stage);
    list.into_iter()
        .filter(|(stage, ..)| work.language || !of_language(stage))
        .map(|(stage, cpu, gpu, scale)| {
            let delayed = stage == "splats" && work.on_cpu && work.language;
            let beside = if delayed { NETWORKS * pixels } else { 0.0 };
            Part { stage, own: scale * if work.on_cpu { cpu } else { gpu }, beside }
        })
        .collect()
}

/// Course of a run.
#[derive(Default)]
struct Course {
    parts: Vec<Part>,
    built_in: bool,
    /// Index of the current or last stage.
    at: usize,
    /// Start of the current stage; `None` between two.
    began: Option<f64>,
    /// Finished share of the current stage, of its time.
    share: f64,
    /// Typical and true seconds of the finished stages.
    finished: [f64; 2],
}

impl Course {
    /// A stage of the first lane begins at `now`, seconds.
    fn begin(&mut self, stage: &str, now: f64) {
        self.end(now);
        // Others are parts of the last one or come before all.
        if let Some(at) = self.parts.iter().position(|p| p.stage == stage) {
            (self.at, self.began, self.share) = (at, Some(now), 0.0);
        }
    }

    fn step(&mut self, done: u64, steps: u64) {
        let share = (done as f64 / steps.max(1) as f64).min(1.0);
        self.share = self.parts.get(self.at).map_or(share, |part| part.time_share(share));
    }

    fn end(&mut self, now: f64) {
        if let (Some(began), Some(part)) = (self.began.take(), self.parts.get(self.at)) {
            self.finished[0] += part.seconds();
            self.finished[1] += now - began;
            self.share = 1.0;
        }
    }

    /// Place in the run and an estimate of the seconds left at `now`.
    fn overall(&self, now: f64) -> Option<Overall> {
        let current = self.parts.get(self.at)?;
        let elapsed = self.began.map_or(0.0, |began| now - began);
        // The time of the cameras is the first measure of the machine.
        let known = self.built_in && self.parts.iter().position(|p| p.stage == "cameras") <= Some(self.at);
        let running = if self.began.is_some() { self.share } else { 0.0 };
        let typical = self.finished[0] + running * current.seconds();
        let true_seconds = self.finished[1] + if running > 0.0 { elapsed } else { 0.0 };
        let pace = (PRIOR + true_seconds) / (PRIOR + typical);
        let trust = (self.share / OWN_PACE).min(1.0);
        let own = elapsed * (1.0 - self.share) / self.share.max(1e-9);
        // A stage that overruns is nearly done.
        let usual = (pace * current.seconds() - elapsed).max(0.0) * (1.0 - trust);
        let rest = if self.share > 0.0 { trust * own + usual } else { usual };
        let later: f64 = self.parts[self.at + 1..].iter().map(Part::seconds).sum();
        Some(Overall {
            stage: self.at + 1,
            stages: self.parts.len(),
            seconds_left: known.then_some(rest + pace * later),
        })
    }
}

/// Progress that reports where in a run the stages of the first lane are, and how long it still
/// takes.
pub(super) struct WithRemaining<'a> {
    inner: &'a dyn Progress,
    began: Instant,
    course: Mutex<(Course, u64)>,
}

impl<'a> WithRemaining<'a> {
    pub(super) fn new(inner: &'a dyn Progress) -> Self {
        WithRemaining { inner, began: Instant::now(), course: Mutex::default() }
    }

    /// The size of the work is known from here on.
    pub(super) fn plan(&self, work: &Work) {
        let course = &mut lock(&self.course).0;
        (course.parts, course.built_in) = (parts(work), work.built_in);
    }

    fn tell(&self, change: impl FnOnce(&mut (Course, u64), f64)) {
        let now = self.began.elapsed().as_secs_f64();
        let mut course = lock(&self.course);
        change(&mut course, now);
        let overall = course.0.overall(now);
        drop(course);
        if let Some(overall) = overall {
            self.inner.overall(overall);
        }
    }
}

impl Progress for WithRemaining<'_> {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.tell(|(course, length), now| {
            course.begin(stage, now);
            *length = steps;
        });
        self.inner.begin(stage, steps);
    }
    fn step(&self, done: u64, note: &str) {
        self.tell(|(course, length), _| course.step(done, *length));
        self.inner.step(done, note);
    }
    fn figures(&self, step: u64, figures: &[(&str, f64)]) {
        self.inner.figures(step, figures);
    }
    fn end(&self) {
        self.tell(|(course, _), now| course.end(now));
        self.inner.end();
    }
    fn warn(&self, message: &str) {
        self.inner.warn(message);
    }
    fn inform(&self, message: &str) {
        self.inner.inform(message);
    }
    fn cancelled(&self) -> bool {
        self.inner.cancelled()
    }
    fn second_lane(&self) -> Box<dyn Progress + '_> {
        self.inner.second_lane()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn work() -> Work {
        let pixels = 4 * 640 * 480;
        Work { on_cpu: true, photos: 4, fine: 0, pixels, steps: 200, language: true, built_in: true }
    }

    fn course(work: &Work) -> Course {
        Course { parts: parts(work), built_in: work.built_in, ..Course::default() }
    }

    /// A stage: begin, seconds, and finished (share of the steps, seconds).
    type Measured = (&'static str, f64, f64, &'static [(f64, f64)]);

    /// Stages of the first lane of runs on two quiet cores: breakfast, and four photos of 12
    /// megapixels at 600 × 800.
    const RUNS: [(f64, [usize; 2], &[Measured]); 2] = [
        (
            41.8,
            [0, 4 * 640 * 480],
            &[
                ("photos", 0.1, 0.0, &[]),
                ("features", 0.3, 0.1, &[]),
                ("cameras", 0.5, 2.9, &[]),
                ("dense stereo", 3.4, 8.6, &[(0.12, 1.3), (0.33, 3.0), (0.62, 5.2), (0.998, 8.6)]),
                ("surfaces", 12.1, 1.8, &[]),
                ("initial splats", 13.9, 1.5, &[]),
                ("splats", 15.4, 24.0, &[(0.09, 3.0), (0.24, 9.0), (0.41, 13.3), (0.65, 17.4), (0.96, 23.0)]),
                ("language", 39.5, 0.7, &[]),
                ("decode", 40.2, 0.7, &[]),
                ("query", 40.9, 0.1, &[]),
                ("seen", 40.9, 0.3, &[]),
                ("write", 41.3, 0.5, &[]),
            ],
        ),
        (
            74.0,
            [4, 4 * 600 * 800],
            &[
                ("photos", 0.1, 1.8, &[]),
                ("features", 2.1, 0.2, &[]),
                ("cameras", 2.3, 9.7, &[]),
                ("dense stereo", 12.3, 13.2, &[(0.12, 2.1), (0.33, 4.6), (0.62, 8.2), (1.0, 13.2)]),
                ("surfaces", 25.5, 3.7, &[]),
                ("initial splats", 29.2, 2.7, &[]),
                (
                    "splats",
                    31.8,
                    35.1,
                    &[(0.09, 4.5), (0.24, 13.0), (0.41, 19.9), (0.65, 26.1), (0.96, 33.8)],
                ),
                ("view dependence", 67.0, 2.9, &[]),
                ("language", 70.0, 1.4, &[]),
                ("decode", 71.4, 1.1, &[]),
                ("query", 72.5, 0.2, &[]),
                ("seen", 72.6, 0.4, &[]),
                ("write", 73.1, 0.9, &[]),
            ],
        ),
    ];

    /// From half-way on the estimate is right within a third, and two seconds: whether there is a
    /// view-dependence stage is not known before.
    #[test]
    fn estimate_follows_measured_runs() {
        // Another machine, of another pace, has the same estimates.
        for (pace, (total, [fine, pixels], stages)) in
            [1.0, 4.0].into_iter().flat_map(|p| RUNS.map(|r| (p, r)))
        {
            let total = pace * total;
            let mut course = course(&Work { fine, pixels, ..work() });
            let mut checked = 0;
            for (stage, from, seconds, shares) in stages {
                let from = pace * from;
                course.begin(stage, from);
                assert_eq!(course.overall(from).unwrap().stages, 13);
                for (steps, after) in *shares {
                    course.step((1000.0 * steps) as u64, 1000);
                    let now = from + pace * after;
                    let (left, truth) = (course.overall(now).unwrap().seconds_left.unwrap(), total - now);
                    println!("{stage} {steps} at {now:.0} s: {left:.1} s left, in truth {truth:.1}");
                    if now > 0.5 * total {
                        assert!((left - truth).abs() < truth / 3.0 + 2.0, "{left:.0}, {truth:.0}");
                        checked += 1;
                    }
                }
                course.end(from + pace * seconds);
            }
            assert!(checked >= 4);
            assert!(course.overall(total).unwrap().seconds_left.unwrap() < 1.0, "all is done");
        }
    }

    #[test]
    fn networks_and_first_stages_have_no_estimate() {
        let mut known = course(&work());
        known.begin("photos", 0.0);
        assert_eq!(known.overall(0.0), Some(Overall { stage: 1, stages: 13, seconds_left: None }));
        known.begin("pointmaps", 1.0);
        assert_eq!(known.overall(1.0).unwrap().stage, 1, "not one of the list");
        known.begin("cameras", 2.0);
        assert!(known.overall(2.0).unwrap().seconds_left.is_some());
        let mut networks = course(&Work { built_in: false, language: false, ..work() });
        networks.begin("splats", 5.0);
        assert_eq!(networks.overall(5.0), Some(Overall { stage: 7, stages: 10, seconds_left: None }));
        assert_eq!(Course::default().overall(0.0), None, "before the plan");
    }
}
