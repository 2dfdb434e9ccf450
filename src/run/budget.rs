//! Memory of a run, estimated before it begins: bytes per stage from the number and the sizes of
//! the photos, against the limits of the device and the free memory of the host.
//!
//! Figures per pixel and splat are those of the buffers that the stages create (`fit::views`,
//! `fit::model`, `pass::rasterizer`, `pass::ssim_l1`, `pose::stereo`); those of the host are
//! measured (docs/internals/performance.md).
use crate::fit::{Preset, RgbOptions};
use crate::gpu::DeviceInfo;
use crate::pass::UpdateKernel;
use crate::pass::bands::{Bands, widest};
use crate::pass::plane_sweep::MAX_SOURCES;
use crate::pass::raster_forward::BASE_CHANNELS;
use crate::photo::{SMALLEST_SIDE, working_size};
use crate::scene::LEVEL_NAMES;
use crate::{Error, Result};

/// Host bytes per pixel of all photos: images, depth, points, masks, labels, and at the end every
/// view with its codes.
const HOST_PIXEL: u64 = 150;
/// Host bytes per pixel of all photos at stereo size: planes, and the surfaces made from them.
const STEREO_PIXEL: u64 = 150;
/// Host bytes per pixel of one photo at the input size of the edge network: three maps of 64
/// channels.
const NETWORK_PIXEL: u64 = 768;
/// Longest input side of the edge network, pixels (`infer::hed`).
const NETWORK_SIDE: usize = 1600;
/// Host bytes independent of the photos: networks, texts, the program.
const HOST_BASE: u64 = 300 << 20;
/// Views that stereo binds at once: a reference and its sources.
const STEREO_VIEWS: u64 = MAX_SOURCES as u64 + 1;
/// Share of a device's memory that buffers may fill: drivers keep some, and allocations leave gaps.
const HEAP_SHARE: f64 = 0.9;
/// Memory limits of a machine.
#[derive(Clone, Debug)]
pub struct Limits {
    /// The device.
    pub device: DeviceInfo,
    /// Free memory of the host, bytes; `None` if the system does not report it.
    pub host: Option<u64>,
}

impl Limits {
    /// Limits of this machine at present.
    pub fn now(device: &DeviceInfo) -> Limits {
        Limits { device: device.clone(), host: available() }
    }
}

/// Settings that determine the memory of a run.
#[derive(Clone, Copy, Debug)]
pub struct MemoryDemand {
    /// Feature channels that train together; 0 without language.
    pub features: usize,
    /// Maximum number of splats.
    pub splats: usize,
    /// Virtual views, at half the size of the photos.
    pub virtual_views: usize,
}

/// Options of the colour stage for a number of photos; the paper's do not depend on it.
pub fn rgb_options(preset: Preset, photos: usize) -> RgbOptions {
    let options = RgbOptions::preset(preset);
    if preset == Preset::Paper { options } else { options.for_photos(photos) }
}

impl MemoryDemand {
    /// Demand of a run with codes of this length; `per_level` trains the levels one after the
    /// other.
    pub fn language(code_dim: usize, per_level: bool, preset: Preset, photos: usize) -> MemoryDemand {
        let levels = if per_level { 1 } else { LEVEL_NAMES.len() };
        MemoryDemand { features: levels * code_dim, ..MemoryDemand::colour(preset, photos) }
    }

    /// Demand of a run without language.
    pub fn colour(preset: Preset, photos: usize) -> MemoryDemand {
        let options = rgb_options(preset, photos);
        let (splats, virtual_views) = (options.most_splats(), options.virtual_views);
        MemoryDemand { features: 0, splats, virtual_views }
    }
}

/// Peak memory of a stage, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StageMemory {
    /// Name of the stage in the progress output.
    pub name: &'static str,
    /// Bytes on the device.
    pub device: u64,
    /// Bytes on the host, without those of a CPU device.
    pub host: u64,
}

/// Memory per stage for photos of these working sizes.
///
/// # Errors
/// An image that cannot be rendered even in bands.
pub fn stages(
    device: &DeviceInfo,
    sizes: &[(usize, usize)],
    work: &MemoryDemand,
) -> Result<Vec<StageMemory>> {
    let all: u64 = sizes.iter().map(pixels).sum();
    // `pose::stereo` halves the size until a reference and its sources fit. This is their upper
    // bound.
    let group = 16 * all.min(STEREO_VIEWS * sizes.iter().map(pixels).max().unwrap_or(0));
    let share = (device.max_storage_range as f64 / group.max(1) as f64).min(1.0);
    let matched = (all as f64 * share) as u64;
    let network_pixels = sizes.iter().map(|s| pixels(&working_size(s.0, s.1, NETWORK_SIDE))).max();
    let network = NETWORK_PIXEL * network_pixels.unwrap_or(0);
    // Freed memory stays with the process, so the maximum counts in all stages.
    let host = HOST_BASE + HOST_PIXEL * all + STEREO_PIXEL * matched + network;
    let stereo = StageMemory { name: "dense stereo", device: 24 * matched, host };
    let virtual_sizes = sizes.iter().cycle().take(work.virtual_views);
    let half = virtual_sizes.map(|(w, h)| (w.div_ceil(2), h.div_ceil(2)));
    let trained: Vec<(usize, usize)> = sizes.iter().copied().chain(half).collect();
    let bytes = training_bytes(device, &trained, work.splats, 0)?;
    let colour = StageMemory { name: "splats", device: bytes, host };
    let mut stages = vec![stereo, colour];
    if work.features > 0 {
        let bytes = training_bytes(device, sizes, work.splats, work.features)?;
        stages.push(StageMemory { name: "language", device: bytes, host });
    }
    Ok(stages)
}

fn pixels(&(width, height): &(usize, usize)) -> u64 {
    (width * height) as u64
}

/// Bytes on the device during training with this many feature channels.
fn training_bytes(
    device: &DeviceInfo,
    sizes: &[(usize, usize)],
    splats: usize,
    features: usize,
) -> Result<u64> {
    let (channels, splats) = (BASE_CHANNELS + features, splats as u64);
    // All photos share the memory of the largest.
    let mut stored = 0;
    for &(w, h) in sizes {
        stored = stored.max(Bands::new(device, w, h, channels)?.pixels() as u64);
    }
    // Planes and their gradients; transmittance, loss; SSIM: three vec2 and one float per colour.
    let mut bytes = stored * (4 * (2 * channels as u64 + 1) + 8 + 84);
    // Projected splats: 12 + 12 floats, the features and their gradients, depth keys and their
    // sort; six entries of 20 bytes in the lists.
    bytes += splats * (96 + 8 * features as u64 + 16 + 120);
    // Photo, wanted alpha; depth, or a label per level.
    bytes += sizes.iter().map(pixels).sum::<u64>() * (16 + if features > 0 { 12 } else { 4 });
    // Value, gradient and moments of each parameter, at SH degree 0; the fused update stores no
    // gradients but those of the features.
    let geometry = if UpdateKernel::of(device) == UpdateKernel::Fused { 8 * 14 } else { 12 * 14 };
    Ok(bytes + splats * (geometry + 12 * features as u64))
}

/// Reason why photos of these sizes do not fit, or `None`.
fn obstacle(limits: &Limits, sizes: &[(usize, usize)], work: &MemoryDemand) -> Option<String> {
    let device = &limits.device;
    let stages = match stages(device, sizes, work) {
        Ok(stages) => stages,
        Err(_) => {
            let most = widest(device, BASE_CHANNELS + work.features);
            return Some(format!("{} renders images up to {most} pixels wide", device.name));
        }
    };
    for stage in stages {
        let heap = (device.memory as f64 * HEAP_SHARE) as u64;
        if !device.is_cpu && stage.device > heap {
            return Some(format!(
                "{} needs {:.1} GiB of {}, which has {:.1}",
                stage.name,
                gib(stage.device),
                device.name,
                gib(device.memory)
            ));
        }
        let needed = stage.host + if device.is_cpu { stage.device } else { 0 };
        if let Some(free) = limits.host.filter(|free| needed > *free) {
            return Some(format!(
                "{} needs about {:.1} GiB of memory, {:.1} are free",
                stage.name,
                gib(needed),
                gib(free)
            ));
        }
    }
    None
}

fn gib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 30)
}

/// Sizes of the photos at a working size.
fn scaled(originals: &[(usize, usize)], max_size: usize) -> Vec<(usize, usize)> {
    originals.iter().map(|&(w, h)| working_size(w, h, max_size)).collect()
}

/// The largest value from `least` on, below `most`, that `fits`; `None` where `least` does not.
fn largest_fitting(least: usize, most: usize, fits: impl Fn(usize) -> bool) -> Option<usize> {
    if least >= most || !fits(least) {
        return None;
    }
    let (mut fitting, mut too_large) = (least, most);
    while too_large - fitting > 1 {
        let middle = fitting + (too_large - fitting) / 2;
        if fits(middle) { fitting = middle } else { too_large = middle }
    }
    Some(fitting)
}

/// Number of photos of these (width, height) that fit, whichever they are. `work` is the demand of
/// a number of photos.
pub fn most_photos(
    limits: &Limits,
    originals: &[(usize, usize)],
    max_size: usize,
    work: impl Fn(usize) -> MemoryDemand,
) -> usize {
    let mut sizes = scaled(originals, max_size);
    sizes.sort_by_key(|s| std::cmp::Reverse(pixels(s)));
    let fits = |count: usize| obstacle(limits, &sizes[..count], &work(count)).is_none();
    largest_fitting(0, sizes.len() + 1, |count| count == 0 || fits(count)).unwrap_or(0)
}

/// Refuses a working size that does not fit, and names the largest size and number of photos that
/// do. `originals` are the (width, height) of the photos, `work` the demand of a number of them.
pub fn check(
    limits: &Limits,
    originals: &[(usize, usize)],
    max_size: usize,
    work: impl Fn(usize) -> MemoryDemand,
) -> Result<()> {
    let count = originals.len();
    let demand = work(count);
    let obstacle_at = |size: usize| obstacle(limits, &scaled(originals, size), &demand);
    let Some(reason) = obstacle_at(max_size) else { return Ok(()) };
    let longest = originals.iter().map(|s| s.0.max(s.1)).max().unwrap_or(0).min(max_size);
    let fewer = most_photos(limits, originals, max_size, work);
    let fewer = (fewer >= 2).then(|| format!("--views {fewer}"));
    let smaller = largest_fitting(SMALLEST_SIDE, longest, |size| obstacle_at(size).is_none());
    let smaller = smaller.map(|size| format!("--max-size {size}"));
    let ways: Vec<String> = fewer.into_iter().chain(smaller).collect();
    Err(Error::input(match ways.as_slice() {
        [] => format!("{count} photos are too many for this machine: {reason}"),
        ways => format!(
            "{count} photos of {longest} pixels are too large for this machine: {reason}; the largest that works is {}",
            ways.join(" or ")
        ),
    }))
}

/// Maximum number of splats that the device binds with this many features, the widest row but for
/// lists of six entries with gradients.
pub fn most_splats(device: &DeviceInfo, features: usize) -> usize {
    let row_bytes = (4 * features).max(96);
    (device.max_storage_range / row_bytes as u64) as usize
}

/// Memory of the host that is available without swapping, bytes.
fn available() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix("MemAvailable:"))?;
    line.split_whitespace().next()?.parse::<u64>().ok().map(|kib| kib * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::test_device;

    fn limits(gib: u64) -> Limits {
        let mut device = test_device().info().clone();
        device.max_storage_range = 128 << 20;
        Limits { device, host: Some(gib << 30) }
    }

    const PHOTOS: [(usize, usize); 4] = [(4032, 3024); 4];

    #[test]
    fn budget_names_largest_fitting_size() {
        let work = |photos| MemoryDemand::language(16, false, Preset::Draft, photos);
        assert!(check(&limits(4), &PHOTOS, 800, work).is_ok());
        let e = check(&limits(4), &PHOTOS, 4032, work).unwrap_err();
        assert_eq!(e.exit_code(), 2);
        let message = e.to_string();
        let named: usize = message.rsplit(' ').next().unwrap().parse().unwrap();
        assert!((800..4032).contains(&named), "{message}");
        assert!(check(&limits(4), &PHOTOS, named, work).is_ok());
        assert!(check(&limits(4), &PHOTOS, named + 1, work).is_err());
        assert!(check(&limits(1), &PHOTOS, 800, work).unwrap_err().to_string().contains("GiB"));
    }

    #[test]
    fn budget_names_largest_number_of_photos() {
        let work = |photos| MemoryDemand::colour(Preset::Draft, photos);
        let many = [PHOTOS[0]; 300];
        let fitting = most_photos(&limits(8), &many, 800, work);
        assert!((5..300).contains(&fitting), "{fitting}");
        assert!(check(&limits(8), &many[..fitting], 800, work).is_ok());
        let message = check(&limits(8), &many[..fitting + 1], 800, work).unwrap_err().to_string();
        assert!(message.contains(&format!("works is --views {fitting} or --max-size ")), "{message}");
        assert_eq!(most_photos(&limits(1000), &many, 800, work), 300);
        assert_eq!(most_photos(&limits(0), &many, 800, work), 0);
    }

    #[test]
    fn budget_refuses_images_wider_than_bands() {
        let work = |photos| MemoryDemand::language(16, false, Preset::Draft, photos);
        let wide = [(40_000, 2000); 2];
        let message = check(&limits(1000), &wide, 40_000, work).unwrap_err().to_string();
        assert!(message.contains("pixels wide") && message.contains("--max-size"), "{message}");
        assert!(check(&limits(1000), &wide, 8000, work).is_ok());
    }

    #[test]
    fn budget_limits_gpu_to_its_memory() {
        let mut limits = limits(1000);
        (limits.device.is_cpu, limits.device.memory) = (false, 2 << 30);
        let work = |photos| MemoryDemand::language(16, false, Preset::Default, photos);
        assert!(check(&limits, &PHOTOS, 1600, work).is_ok());
        let many = [(4032, 3024); 16];
        assert!(check(&limits, &many, 4032, work).unwrap_err().to_string().contains("which has 2.0"));
    }
}
