//! Times of kernel variants on a seeded scene, by timestamps on the device.
use super::choose::{self, Choice, Times, Timing};
use crate::gpu::{Device, KernelVariant, Options, Program, Recorder};
use crate::math::Random;
use crate::pass::adam::{Class, Moments, Schedule};
use crate::pass::bands::Bands;
use crate::pass::fused_update::{self, SplatAdam};
use crate::pass::project::DEPTH_BITS;
use crate::pass::regularise::{self, RatioPenalty};
use crate::pass::sort::{Sort, SortAlgorithm};
use crate::pass::ssim_l1::{SsimL1, SsimRowKernel};
use crate::pass::sum::PARTIALS;
use crate::pass::{
    DeviceChoices, GradientReduction, RasterOptions, Rasterizer, ShGradientKernel, SplatBuffers, TileBinning,
    TileSums, View,
};
use crate::scene::{Camera, Splats, seeded};
use crate::{Error, Result};
use std::collections::BTreeSet;
use std::time::{Duration, Instant};

/// Size of the seeded scene.
#[derive(Clone, Copy, Debug)]
pub struct SceneSize {
    /// Number of splats.
    pub splats: usize,
    /// Width and height, pixels.
    pub pixels: [u32; 2],
}

impl SceneSize {
    /// About a scene of four photos; a smaller one on a CPU device, whose passes take hundreds of
    /// times as long.
    fn of(is_cpu: bool) -> SceneSize {
        match is_cpu {
            true => SceneSize { splats: 40_000, pixels: [320, 240] },
            false => SceneSize { splats: 150_000, pixels: [640, 480] },
        }
    }
}

/// Runs before the first measured one: the driver compiles in the first, caches settle in the next.
const WARM_UP: usize = 2;
/// Fewest measured runs of a variant, for a median.
const FEWEST: usize = 7;
/// Most measured runs.
const MOST: usize = 101;
/// Measurement of a pair beyond [`FEWEST`] runs, for GPUs, where a pass takes a tenth of a
/// millisecond and the clock rises while it is measured.
const PAIR: Duration = Duration::from_millis(300);
/// Rates of Adam: every run does the same work.
const STILL: [[f64; 2]; 5] = [[0.0; 2]; 5];
const NEEDLES: RatioPenalty = RatioPenalty { weight: 0.25, limit: 2.0 };
const SH_DEGREE: u32 = 3;

/// Times the variants of [`crate::gpu::VariantPair::TIMED`] on the device that `options` open, and
/// chooses as [`choose::choose`] does. Wrong variants are not timed and not used by the others.
///
/// # Errors
/// Those of the device, and of `check`, which is called before each pair.
pub fn time_variants(
    options: &Options,
    size: Option<SceneSize>,
    remembered: &BTreeSet<String>,
    wrong: &BTreeSet<KernelVariant>,
    until: Instant,
    check: &mut dyn FnMut() -> Result<()>,
) -> Result<Vec<Choice>> {
    let mut timer = Timer::open(options, wrong, size, until)?;
    let is_cpu = timer.device.info().is_cpu;
    choose::choose(is_cpu, remembered, wrong, until, |variants, preferred| {
        check()?;
        timer.prefer(preferred)?;
        timer.time(variants)
    })
}

struct Timer {
    options: Options,
    device: Device,
    splats: Splats,
    camera: Camera,
    until: Instant,
}

impl Timer {
    fn open(
        options: &Options,
        wrong: &BTreeSet<KernelVariant>,
        size: Option<SceneSize>,
        until: Instant,
    ) -> Result<Timer> {
        // Shaders are timed: without native code, their preferences count on a CPU device, too.
        let off = wrong.iter().chain([&KernelVariant::NativePasses]).map(|v| v.name().to_owned()).collect();
        let preferred = Some(BTreeSet::new());
        let options =
            Options { natives: &[], deterministic: false, disabled: off, preferred, ..options.clone() };
        let device = Device::open(&options)?;
        let SceneSize { splats, pixels: [width, height] } =
            size.unwrap_or(SceneSize::of(device.info().is_cpu));
        let (splats, camera) = seeded::benchmark(splats, width, height, SH_DEGREE, 1);
        Ok(Timer { options, device, splats, camera, until })
    }

    /// Opens the device anew where others are preferred.
    fn prefer(&mut self, preferred: &BTreeSet<String>) -> Result<()> {
        if self.options.preferred.as_ref() != Some(preferred) {
            self.options.preferred = Some(preferred.clone());
            self.device = Device::open(&self.options)?;
        }
        Ok(())
    }

    fn time(&self, variants: [KernelVariant; 2]) -> Result<Timing> {
        let [a, b] = variants.map(|variant| self.record(variant));
        let (Some(a), Some(b)) = (a?, b?) else { return Ok(Timing::Unusable) };
        let recorded = [a.compile()?, b.compile()?];
        for _ in 0..WARM_UP {
            recorded.iter().try_for_each(|r| r.milliseconds(&self.device).map(drop))?;
        }
        // In turn: both see the same clocks and the same other work.
        let [a, b] = &recorded;
        let (mut rounds, begun) = (Vec::new(), Instant::now());
        while rounds.len() < MOST && (rounds.len() < FEWEST || begun.elapsed() < PAIR) {
            if Instant::now() >= self.until {
                break;
            }
            rounds.push([a.milliseconds(&self.device)?, b.milliseconds(&self.device)?]);
        }
        Ok(if rounds.len() < FEWEST { Timing::OutOfTime } else { Timing::Measured(Times::of(&rounds)) })
    }

    /// A variant's pass, with those before it that cannot be left out; `None` where the device
    /// cannot run it.
    fn record(&self, variant: KernelVariant) -> Result<Option<Recorded>> {
        let choices = DeviceChoices::of(&self.device);
        let by_atomics = DeviceChoices { summation: GradientReduction::Atomics, ..choices };
        let by_entries = DeviceChoices { summation: GradientReduction::Entries, ..choices };
        Ok(Some(match variant {
            KernelVariant::ChunkSort => self.sort(SortAlgorithm::Chunks)?,
            KernelVariant::SweepSort => self.sort(SortAlgorithm::Sweep)?,
            KernelVariant::CountedLists => self.lists(TileBinning::Counting)?,
            KernelVariant::SortedLists => self.lists(TileBinning::Sorting)?,
            KernelVariant::ShuffledSums => {
                self.gradients(DeviceChoices { tile_sums: TileSums::Shuffles, ..by_atomics })?
            }
            KernelVariant::SharedSums => {
                self.gradients(DeviceChoices { tile_sums: TileSums::Shared, ..by_atomics })?
            }
            KernelVariant::AtomicGradients => self.gradients(by_atomics)?,
            KernelVariant::StoredGradients => self.gradients(by_entries)?,
            KernelVariant::ShPerThread => self.sh_gradients(ShGradientKernel::PerThread)?,
            KernelVariant::ShShared => self.sh_gradients(ShGradientKernel::Shared)?,
            KernelVariant::SeparateUpdate => self.separate_update()?,
            KernelVariant::FusedUpdate if fused_update::fits(self.device.info()) => self.fused_update()?,
            KernelVariant::SsimStrips => self.ssim(SsimRowKernel::Strips)?,
            KernelVariant::SsimShared => self.ssim(SsimRowKernel::Shared)?,
            _ => return Ok(None),
        }))
    }

    /// Sorts random keys, as many as there are splats.
    fn sort(&self, algorithm: SortAlgorithm) -> Result<Recorded> {
        let count = self.splats.len() as u32;
        let mut random = Random::new(1);
        let pairs: Vec<[u32; 2]> = (0..count).map(|i| [random.bits() as u32, i]).collect();
        let unsorted = self.device.buffer_from("unsorted", pairs.as_flattened())?;
        let sorted = self.device.buffer::<u32>("sorted", 2 * pairs.len())?;
        let counted = self.device.buffer_from("count", &[count])?;
        let sort = Sort::with(&self.device, pairs.len(), algorithm)?;
        let mut rec = Recorder::new(&self.device, "timing of the sort");
        rec.pass("restore the unsorted keys");
        rec.copy(&unsorted, &sorted);
        rec.pass("depth sort");
        sort.record(&mut rec, &sorted, &counted, DEPTH_BITS);
        Ok(Recorded { rec, passes: &["depth sort"] })
    }

    fn lists(&self, grouping: TileBinning) -> Result<Recorded> {
        let rendered = self
            .rendered(DeviceChoices { grouping, ..DeviceChoices::of(&self.device) }, "timing of binning")?;
        let Rendered { mut rec, params, raster, options } = rendered;
        raster.record_forward(&mut rec, &params, &options);
        Ok(Recorded { rec, passes: &["binning"] })
    }

    fn gradients(&self, choices: DeviceChoices) -> Result<Recorded> {
        let Rendered { mut rec, params, raster, options } =
            self.rendered(choices, "timing of the gradients")?;
        raster.record_band_backward(&mut rec, &params, &options, &raster.frame().bands.get(0));
        Ok(Recorded { rec, passes: &["raster backward"] })
    }

    fn sh_gradients(&self, sh_gradients: ShGradientKernel) -> Result<Recorded> {
        let choices = DeviceChoices { sh_gradients, ..DeviceChoices::of(&self.device) };
        let Rendered { mut rec, params, raster, options } =
            self.backward(choices, "timing of SH gradients")?;
        let gradients = params.zeros_like(&self.device)?;
        raster.record_splat_gradients(&mut rec, &params, &options, &gradients);
        Ok(Recorded { rec, passes: &["projection backward"] })
    }

    fn fused_update(&self) -> Result<Recorded> {
        let Rendered { mut rec, params, raster, options } =
            self.backward(DeviceChoices::of(&self.device), "timing of the update")?;
        let (moments, schedule) = self.adam(&params)?;
        let state = SplatAdam { moments: &moments, schedule: &schedule, needles: Some(NEEDLES) };
        raster.record_update(&mut rec, &params, &options, &state);
        Ok(Recorded { rec, passes: &[fused_update::PASS] })
    }

    fn separate_update(&self) -> Result<Recorded> {
        let Rendered { mut rec, params, raster, options } =
            self.backward(DeviceChoices::of(&self.device), "timing of the update")?;
        let (moments, schedule) = self.adam(&params)?;
        let gradients = params.zeros_like(&self.device)?;
        raster.record_splat_gradients(&mut rec, &params, &options, &gradients);
        regularise::record_ratio(&mut rec, &params.log_scales, &gradients.log_scales, params.count, NEEDLES);
        let (values, gradients) = (classes(&params), classes(&gradients));
        for (slot, ((buffer, width), (gradient, _))) in values.into_iter().zip(gradients).enumerate() {
            let width = width as u32;
            let class =
                Class { slot: slot as u32, count: params.count * width as usize, stride: width, head: width };
            schedule.record(&mut rec, class, buffer, gradient, &moments[slot], &raster.frame().status);
        }
        Ok(Recorded { rec, passes: &["projection backward", "regularisers", "Adam"] })
    }

    fn ssim(&self, rows: SsimRowKernel) -> Result<Recorded> {
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let mut random = Random::new(2);
        let mut noise = || (0..3 * width * height).map(|_| random.uniform() as f32).collect::<Vec<f32>>();
        let rendered = self.device.buffer_from("rendered", &noise())?;
        let target = self.device.buffer_from("target", &noise())?;
        let gradient = self.device.buffer::<f32>("gradient", 3 * width * height)?;
        let sums = self.device.buffer::<f32>("loss", 2 * PARTIALS)?;
        let bands = Bands::whole(width, height);
        let pass = SsimL1::with(&self.device, std::slice::from_ref(&bands), rows)?;
        let mut rec = Recorder::new(&self.device, "timing of SSIM");
        let band = (&bands, &bands.get(0));
        pass.record(&mut rec, band, &rendered, &target, &gradient, None, [0.8, 0.2], (&sums, 0));
        Ok(Recorded { rec, passes: &["SSIM + L1"] })
    }

    /// The scene after a forward pass, with gradients by its pixels, and an empty recording.
    fn rendered(&self, choices: DeviceChoices, label: &str) -> Result<Rendered> {
        let (width, height) = (self.camera.width, self.camera.height);
        let params = SplatBuffers::upload(&self.device, &self.splats, &[], 0)?;
        let mut raster = Rasterizer::with(&self.device, params.count, 0, width, height, choices)?;
        if raster.frame().bands.count() > 1 {
            return Err(Error::work("the device does not render the timed scene at once"));
        }
        raster.set_view(&View::new(&self.camera, 0.01))?;
        let options = RasterOptions { sh_degree: SH_DEGREE, ..RasterOptions::default() };
        raster.forward(&params, &options)?;
        let mut random = Random::new(3);
        let upstream = vec![0.0f32; 5 * raster.frame().pixels() as usize];
        let upstream: Vec<f32> = upstream.iter().map(|_| random.scaled_normal(1e-3) as f32).collect();
        raster.frame().planes_grad.write_at(0, &upstream)?;
        Ok(Rendered { rec: Recorder::new(&self.device, label), params, raster, options })
    }

    /// [`Timer::rendered`] after the backward pass to the screen-space splats.
    fn backward(&self, choices: DeviceChoices, label: &str) -> Result<Rendered> {
        let rendered = self.rendered(choices, label)?;
        let mut rec = Recorder::new(&self.device, "gradients on the screen");
        let Rendered { params, raster, options, .. } = &rendered;
        raster.record_band_backward(&mut rec, params, options, &raster.frame().bands.get(0));
        rec.run()?;
        Ok(rendered)
    }

    fn adam(&self, params: &SplatBuffers) -> Result<([Moments; 5], Schedule)> {
        let [a, b, c, d, e] =
            classes(params).map(|(_, width)| Moments::new(&self.device, params.count * width));
        let mut schedule = Schedule::new(&self.device, STILL.len())?;
        schedule.set(1, &STILL)?;
        Ok(([a?, b?, c?, d?, e?], schedule))
    }
}

/// Parameters in the order of [`fused_update::ROWS`], with their values per splat.
fn classes(params: &SplatBuffers) -> [(&crate::gpu::Buffer<f32>, usize); 5] {
    [
        (&params.means, 3),
        (&params.log_scales, 3),
        (&params.quats, 4),
        (&params.opacity_logits, 1),
        (&params.sh, 3 * params.sh_len()),
    ]
}

struct Rendered {
    rec: Recorder,
    params: SplatBuffers,
    raster: Rasterizer,
    options: RasterOptions,
}

struct Recorded {
    rec: Recorder,
    /// Names of the timed passes.
    passes: &'static [&'static str],
}

impl Recorded {
    fn compile(self) -> Result<Compiled> {
        Ok(Compiled { program: self.rec.compile()?, passes: self.passes })
    }
}

struct Compiled {
    program: Program,
    passes: &'static [&'static str],
}

impl Compiled {
    /// Milliseconds of the timed passes; of the whole recording, by the host's clock, where the
    /// device has no timestamps.
    fn milliseconds(&self, device: &Device) -> Result<f64> {
        if device.info().timestamp_period == 0.0 {
            let clock = Instant::now();
            self.program.run()?;
            return Ok(1e3 * clock.elapsed().as_secs_f64());
        }
        let times = self.program.run_timed()?;
        let timed = self.program.passes().zip(times).filter(|(pass, _)| self.passes.contains(pass));
        Ok(timed.map(|(_, (_, ms))| ms).sum())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::VariantPair;

    #[test]
    fn shaders_are_timed_within_limit() {
        let options = Options { cache: None, validation: true, ..crate::gpu::options(None) };
        let size = SceneSize { splats: 1000, pixels: [96, 64] };
        let (begun, none) = (Instant::now(), BTreeSet::new());
        let until = begun + choose::LIMIT;
        let wrong = BTreeSet::from([KernelVariant::SsimShared]);
        let mut pairs = 0;
        let mut check = || {
            pairs += 1;
            Ok(())
        };
        let choices = time_variants(&options, Some(size), &none, &wrong, until, &mut check).unwrap();
        // A pair that has begun ends after its next runs.
        assert!(begun.elapsed() < choose::LIMIT + Duration::from_secs(2), "{:?}", begun.elapsed());
        println!("{:?}: {choices:#?}", begun.elapsed());
        assert_eq!(choices.len(), VariantPair::TIMED.len());
        for Choice { variants, chosen, timing } in &choices {
            assert!(variants.contains(chosen));
            match timing {
                Timing::Measured(times) => {
                    assert!(times.medians.iter().all(|t| *t > 0.0), "{variants:?} {times:?}");
                }
                Timing::Wrong => assert!(variants.contains(&KernelVariant::SsimShared)),
                Timing::OutOfTime => assert!(begun.elapsed() > choose::LIMIT),
                Timing::Unusable => assert!(!fused_update::fits(crate::gpu::test_device().info())),
            }
        }
        assert!(matches!(choices[0].timing, Timing::Measured(_)) && pairs > 0);
    }
}
