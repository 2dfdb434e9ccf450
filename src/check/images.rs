//! Checks of passes over pixels.
use super::compared::{Found, close, equal, worst};
use crate::gpu::{Device, Recorder};
use crate::math::Random;
use crate::pass::Rasterizer;
use crate::pass::bands::Bands;
use crate::pass::channels::BASE_CHANNELS;
use crate::pass::close::Tolerance;
use crate::pass::codes::{self, Targets};
use crate::pass::decode::{Codes, decode_pixels};
use crate::pass::pack::{self, Encoding, FrameChannel};
use crate::pass::plane_sweep::{GpuMatcher, Matcher, ReferenceView, SourceView};
use crate::pass::plane_sweep_cpu::CpuMatcher;
use crate::pass::query_peaks::DeviceSearch;
use crate::pass::ssim_l1::{self, SsimL1, SsimRowKernel};
use crate::query::frame::{FrameSearch, HostSearch, LevelPeaks, Table};
use crate::query::maps::CodeMaps;
use crate::scene::Image;
use glam::Vec4;
use std::sync::Arc;

const SIZE: (usize, usize) = (75, 53);
const PIXELS: usize = SIZE.0 * SIZE.1;

fn noise(count: usize, seed: u64) -> Vec<f32> {
    let mut random = Random::new(seed);
    (0..count).map(|_| random.uniform() as f32).collect()
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| v.into()).collect()
}

pub(super) fn ssim_l1(device: &Device, rows: SsimRowKernel) -> Found {
    let x = noise(3 * PIXELS, 21);
    let y: Vec<f32> = noise(3 * PIXELS, 22).iter().zip(&x).map(|(n, x)| 0.7 * x + 0.3 * n).collect();
    let bands = Bands::whole(SIZE.0, SIZE.1);
    let pass = SsimL1::with(device, std::slice::from_ref(&bands), rows)?;
    let (rendered, target) = (device.buffer_from("rendered", &x)?, device.buffer_from("target", &y)?);
    let gradient = device.buffer::<f32>("gradient", 3 * PIXELS)?;
    let sums = device.buffer::<f32>("loss", 2)?;
    let mut rec = Recorder::new(device, "self-check of the image loss");
    let band = (&bands, &bands.get(0));
    pass.record(&mut rec, band, &rendered, &target, &gradient, None, [0.8, 0.2], (&sums, 0));
    rec.run()?;
    let sums = sums.read()?;
    let loss = ssim_l1::ImageLoss::of(&bands, [sums[0], sums[1]].map(f64::from), None);
    let (reference, by_pixel) = ssim_l1::ssim_l1(&wide(&x), &wide(&y), SIZE.0, SIZE.1, 0.8, 0.2);
    let largest = by_pixel.iter().fold(0.0f64, |m, g| m.max(g.abs()));
    // E[x²] − E[x]² cancels about three digits in f32, and 1/C2 amplifies the rest in flat regions.
    let tolerance = Tolerance {
        relative_l2: 1e-3,
        absolute: 1e-3 * largest,
        relative: 1e-3,
        outliers: 0.0,
        outlier_factor: 1.0,
    };
    let sum = Tolerance { absolute: 1e-5, ..tolerance };
    Ok(worst([
        close("loss", &[loss.l1 as f32, loss.ssim as f32], &[reference.l1, reference.ssim], &sum),
        close("gradient", &gradient.read()?, &by_pixel, &tolerance),
    ]))
}

pub(super) fn codes(device: &Device) -> Found {
    let (width, count) = (5usize, 4usize);
    let mut random = Random::new(23);
    let labels: Vec<i32> = (0..PIXELS).map(|_| random.below(count + 1) as i32 - 1).collect();
    let table: Vec<f32> = (0..count * width).map(|_| random.normal() as f32).collect();
    let raster = Rasterizer::new(device, 1, width, SIZE.0 as u32, SIZE.1 as u32)?;
    let frame = raster.frame();
    let planes: Vec<f32> = (0..(BASE_CHANNELS + width) * PIXELS).map(|_| random.normal() as f32).collect();
    frame.planes.write(&planes)?;
    let (labelled, codes) = (device.buffer_from("labels", &labels)?, device.buffer_from("codes", &table)?);
    let weights = device.buffer_from("weights", &[0.5f32])?;
    let targets =
        Targets { labels: &labelled, codes: &codes, weights: &weights, levels: 1, width: width as u32 };
    let loss = device.buffer::<f32>("loss", PIXELS)?;
    let mut rec = Recorder::new(device, "self-check of the code loss");
    codes::record(&mut rec, &targets, frame, &loss);
    rec.run()?;
    let features = wide(&planes[BASE_CHANNELS * PIXELS..]);
    let (by_pixel, gradient) = codes::code_l1(&labels, &wide(&table), width, 0.5, &features);
    let upstream =
        frame.planes_grad.read()?[BASE_CHANNELS * PIXELS..(BASE_CHANNELS + width) * PIXELS].to_vec();
    let tolerance =
        Tolerance { relative_l2: 1e-6, absolute: 1e-5, relative: 1e-6, outliers: 0.0, outlier_factor: 1.0 };
    Ok(worst([
        close("loss", &loss.read()?, &by_pixel, &tolerance),
        close("gradient", &upstream, &gradient, &tolerance),
    ]))
}

pub(super) fn decode(device: &Device) -> Found {
    let mut result = Ok(String::new());
    // Once for every width that the shader is compiled for.
    for dim in [3usize, 8, 16, 24] {
        let mut random = Random::new(24 + dim as u64);
        let mut codes: Vec<f32> = (0..40 * dim).map(|_| random.normal() as f32).collect();
        for code in codes.chunks_exact_mut(dim) {
            let norm = code.iter().map(|x| x * x).sum::<f32>().sqrt();
            code.iter_mut().for_each(|x| *x /= norm);
        }
        let planes: Vec<f32> = (0..dim * PIXELS).map(|_| random.normal() as f32).collect();
        let alpha = noise(PIXELS, 25);
        let features = device.buffer_from("features", &planes)?;
        let rest: Vec<f32> = alpha.iter().map(|a| 1.0 - a).collect();
        let transmittance = device.buffer_from("transmittance", &rest)?;
        let decoded = device.buffer::<i32>("decoded", PIXELS)?;
        let table = Codes::upload(device, &codes, dim)?;
        let mut rec = Recorder::new(device, "self-check of decoding");
        table.record(&mut rec, &features, 0, &transmittance, PIXELS as u32, &decoded);
        rec.run()?;
        let (mut reference, margin) = decode_pixels(&codes, dim, &planes, &alpha);
        let actual = decoded.read()?;
        for ((t, &a), margin) in reference.iter_mut().zip(&actual).zip(margin) {
            // Sums of at most 32 products in f32: nearly equal codes may win either way.
            if margin < 8e-6 {
                *t = a;
            }
        }
        result = result.and(equal("codes", &actual, &reference));
    }
    Ok(result)
}

pub(super) fn query(device: &Device) -> Found {
    let (width, height) = SIZE;
    let mut random = Random::new(27);
    // Blocks of 3 × 3 pixels of a code, one of thirteen none.
    let mut map = |_| {
        let blocks: Vec<i32> = (0..PIXELS).map(|_| random.below(13) as i32 - 1).collect();
        let data = (0..PIXELS).map(|p| blocks[p / width / 3 * width + p % width / 3]).collect();
        Image { width, height, data }
    };
    let frames: Vec<Arc<CodeMaps>> = (0..2)
        .map(|_| Ok(Arc::new(CodeMaps::new(&[0, 1, 2].map(&mut map))?)))
        .collect::<crate::Result<_>>()?;
    let tables = [28, 29, 30].map(|seed| Table::new(&noise(12, seed)));
    let answering = vec![vec![vec![0, 7, 11], vec![3], Vec::new()]; 2];
    let expected = HostSearch(&frames).search(&tables, &answering)?;
    let Some(mut search) = DeviceSearch::new(device, &frames, 12)? else {
        return Ok(Err("the device does not bind the sums of a small frame".to_owned()));
    };
    let words = |found: Vec<Vec<LevelPeaks>>| -> Vec<u32> {
        found.iter().flatten().flat_map(|f| [f.peak, f.location as u32]).collect()
    };
    Ok(equal("peaks", &words(search.search(&tables, &answering)?), &words(expected)))
}

pub(super) fn pack(device: &Device) -> Found {
    let dim = 6usize;
    let raster = Rasterizer::new(device, 1, dim, SIZE.0 as u32, SIZE.1 as u32)?;
    // Multiples of 1/64 are exact in half precision, and none lies between two 8-bit values.
    let planes: Vec<f32> =
        (0..(BASE_CHANNELS + dim) * PIXELS).map(|i| ((i * 7919 + 13) % 97) as f32 / 64.0).collect();
    let rest: Vec<f32> = (0..PIXELS).map(|i| (i % 9) as f32 / 8.0).collect();
    let frame = raster.frame();
    frame.planes.write(&planes)?;
    frame.transmittance.write(&rest)?;
    let mut result = Ok(String::new());
    for (source, encoding) in [
        (FrameChannel::Colour, Encoding::Unorm8x4),
        (FrameChannel::Depth, Encoding::F32),
        (FrameChannel::Alpha, Encoding::F32x4),
        (FrameChannel::Features(1, 5), Encoding::F16x4),
    ] {
        let texels = pack::texels(device, PIXELS, source, encoding)?;
        pack::pack(device, frame, &frame.bands.get(0), source, encoding, &texels)?;
        let reference = pack::texels_of(&planes, &rest, source, encoding);
        let actual = texels.cast::<u8>().read()?;
        result = result.and(match source {
            FrameChannel::Depth => quotients(&actual, &reference),
            _ => equal("bytes", &actual, &reference),
        });
    }
    Ok(result)
}

/// Compares depths: quotients, for which Vulkan allows an error of 2.5 ULP.
fn quotients(actual: &[u8], reference: &[u8]) -> std::result::Result<String, String> {
    let floats =
        |bytes: &[u8]| -> Vec<f32> { bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect() };
    let tolerance =
        Tolerance { relative_l2: 1e-6, absolute: 1e-9, relative: 4e-7, outliers: 0.0, outlier_factor: 1.0 };
    worst([close("depth", &floats(actual), &wide(&floats(reference)), &tolerance)])
}

/// Compares stereo of two cameras side by side before a wall with noise on it.
pub(super) fn plane_sweep(device: &Device) -> Found {
    let (width, height) = (48usize, 36usize);
    let pixels = width * height;
    let (focal, baseline, depth) = (40.0f32, 0.2f32, 2.0f32);
    let shift = (focal * baseline / depth) as usize;
    let wall = noise((width + shift) * height, 26);
    let columns = |first: usize| (0..pixels).map(move |p| (p % width + first, p / width));
    let luma: Vec<f32> =
        columns(0).chain(columns(shift)).map(|(x, y)| wall[y * (width + shift) + x]).collect();
    let (cx, cy) = (width as f32 / 2.0, height as f32 / 2.0);
    let rows = |t: f32| [[focal, 0.0, cx, focal * t], [0.0, focal, cy, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let source = |first: usize, t: f32| SourceView {
        forward: rows(t),
        back: rows(-t),
        centre: [-t, 0.0, 0.0, 0.0],
        intrinsics: [focal, focal, cx, cy],
        size: [width as u32, height as u32, first as u32, 0],
    };
    let sources = [source(pixels, -baseline), source(0, baseline)];
    let reference = |view: usize| ReferenceView {
        intrinsics: [focal, focal, cx, cy],
        range: [0.2, 1.0],
        seed: 5,
        width: width as u32,
        height: height as u32,
        first: (view * pixels) as u32,
        first_source: view as u32,
        sources: 1,
        planes: 16,
        ..ReferenceView::default()
    };
    let references = [reference(0), reference(1)];
    let start = vec![Vec4::ZERO; 2 * pixels];
    let mut gpu = GpuMatcher::new(device, &luma, &references, &sources, &start)?;
    let mut cpu = CpuMatcher::new(luma.clone(), sources.to_vec(), start);
    for r in &references {
        gpu.sweep(r)?;
        cpu.sweep(r)?;
    }
    let swept = planes(&gpu.planes()?, &cpu.planes()?);
    // From the same planes, so that ties of the sweep have no influence.
    let mut gpu = GpuMatcher::new(device, &luma, &references, &sources, &cpu.planes()?)?;
    for r in references.iter().flat_map(|r| [0, 1].map(|parity| ReferenceView { parity, ..*r })) {
        gpu.refine(&r)?;
        cpu.refine(&r)?;
    }
    Ok(swept.and(planes(&gpu.planes()?, &cpu.planes()?)))
}

/// Compares planes. exp, sqrt and the order of sums round differently, so nearly equal hypotheses
/// may win either way; the bounds are those of the test of stereo.
pub(super) fn planes(actual: &[Vec4], reference: &[Vec4]) -> std::result::Result<String, String> {
    let same = |a: &Vec4, b: &Vec4| (a.truncate() - b.truncate()).length() < 1e-4 * a.truncate().length();
    let agreeing: Vec<(&Vec4, &Vec4)> = actual.iter().zip(reference).filter(|(a, b)| same(a, b)).collect();
    let share = agreeing.len() as f64 / actual.len().max(1) as f64;
    let worst = agreeing.iter().map(|(a, b)| (a.w - b.w).abs()).fold(0.0, f32::max);
    if share < 0.985 || worst > 2e-3 {
        return Err(format!(
            "planes: {:.1} % are the reference's, their costs differ by up to {worst:.1e}",
            100.0 * share
        ));
    }
    Ok(format!("{:.1} % of planes equal, costs to {worst:.1e}", 100.0 * share))
}
