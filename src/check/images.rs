//! Checks of passes over pixels.
use super::compared::{Found, close, each, equal, worst};
use super::{Case, case};
use crate::gpu::{Device, KernelVariant, Recorder};
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
use crate::pass::sum::{self, PARTIALS};
use crate::query::frame::{FrameSearch, HostSearch, LevelPeaks, Table};
use crate::query::maps::CodeMaps;
use crate::scene::Image;
use glam::Vec4;
use std::sync::Arc;

pub(super) const CASES: &[Case] = &[
    case("SSIM and L1 loss", Some(KernelVariant::SsimStrips), |d| ssim_l1(d, SsimRowKernel::Strips)),
    case("SSIM and L1 loss", Some(KernelVariant::SsimShared), |d| ssim_l1(d, SsimRowKernel::Shared)),
    case("code loss", None, codes),
    case("decoding of codes", None, decode),
    case("search of a text query", Some(KernelVariant::DeviceQuery), query),
    case("packing of images", None, pack),
    case("plane sweep stereo", Some(KernelVariant::DeviceSweep), plane_sweep),
];

const SIZE: (usize, usize) = (75, 53);
const PIXELS: usize = SIZE.0 * SIZE.1;

fn noise(count: usize, seed: u64) -> Vec<f32> {
    let mut random = Random::new(seed);
    (0..count).map(|_| random.uniform() as f32).collect()
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| v.into()).collect()
}

/// Sizes with partial strips and workgroups, without weights and with weights that leave out pixels;
/// the whole loss and L1 alone.
fn ssim_l1(device: &Device, rows: SsimRowKernel) -> Found {
    let sizes = [(13, 7), (70, 18), SIZE];
    let cases =
        sizes.into_iter().flat_map(|s| [(s, false, 0.2), (s, true, 0.2), (s, false, 0.0), (s, true, 0.0)]);
    each(cases, |((w, h), weighted, dssim)| {
        let weight = |i: usize| if weighted { [0.0f32, 1.0, 0.25][(i % w / 4 + i / w / 3) % 3] } else { 1.0 };
        let weights: Vec<f32> = (0..w * h).map(weight).collect();
        let covered = weighted.then(|| wide(&weights).iter().sum::<f64>());
        let x = noise(3 * w * h, 21);
        let y: Vec<f32> = noise(3 * w * h, 22).iter().zip(&x).map(|(n, x)| 0.7 * x + 0.3 * n).collect();
        let bands = Bands::whole(w, h);
        let pass = SsimL1::with(device, std::slice::from_ref(&bands), rows)?;
        let rendered = device.buffer_from("rendered", &x)?;
        let planes = if weighted { [&y[..], &weights].concat() } else { y.clone() };
        let target = device.buffer_from("target", &planes)?;
        let gradient = device.buffer::<f32>("gradient", 3 * w * h)?;
        let sums = device.buffer::<f32>("loss", 3 * PARTIALS)?;
        let mut rec = Recorder::new(device, "self-check of the image loss");
        let band = (&bands, &bands.get(0));
        pass.record(&mut rec, band, &rendered, &target, &gradient, covered, [0.8, dssim], (&sums, 1));
        rec.run()?;
        let sums = sums.read()?;
        let loss = ssim_l1::ImageLoss::of(&bands, [1, 2].map(|slot| sum::total(&sums, slot)), covered);
        let (reference, by_pixel) =
            ssim_l1::ssim_l1_weighted(&wide(&x), &wide(&y), &wide(&weights), w, h, 0.8, dssim);
        let largest = by_pixel.iter().fold(0.0f64, |m, g| m.max(g.abs()));
        // E[x²] − E[x]² cancels about three digits in f32, and 1/C2 amplifies the rest in flat
        // regions.
        let tolerance = Tolerance {
            relative_l2: 1e-3,
            absolute: 1e-3 * largest,
            relative: 1e-3,
            outliers: 0.0,
            outlier_factor: 1.0,
        };
        let sum = Tolerance { absolute: 1e-5, ..tolerance };
        Ok(worst([
            close("L1", &[loss.l1 as f32], &[reference.l1], &sum),
            if dssim > 0.0 { close("SSIM", &[loss.ssim as f32], &[reference.ssim], &sum) } else { Ok(0.0) },
            close("gradient", &gradient.read()?, &by_pixel, &tolerance),
        ]))
    })
}

/// Two levels with codes of their own; the gradients of the other planes must not change.
fn codes(device: &Device) -> Found {
    let (levels, width, count) = (2usize, 5usize, 4usize);
    let mut random = Random::new(23);
    let first = |level: usize| (level * count) as i32;
    let labels: Vec<Vec<i32>> = (0..levels)
        .map(|level| {
            let mut label = || random.below(count + 1) as i32 - 1;
            (0..PIXELS).map(|_| label()).map(|l| if l < 0 { l } else { l + first(level) }).collect()
        })
        .collect();
    let mut normal = |n: usize| (0..n).map(|_| random.normal() as f32).collect::<Vec<f32>>();
    let table = normal(levels * count * width);
    let planes = normal((BASE_CHANNELS + levels * width) * PIXELS);
    let level_weights = [0.5f32, 0.25];
    let raster = Rasterizer::new(device, 1, levels * width, SIZE.0 as u32, SIZE.1 as u32)?;
    let frame = raster.frame();
    frame.planes.write(&planes)?;
    frame.planes_grad.write(&vec![7.0; (5 + levels * width) * PIXELS])?;
    let (labelled, codes) =
        (device.buffer_from("labels", &labels.concat())?, device.buffer_from("codes", &table)?);
    let weights = device.buffer_from("weights", &level_weights)?;
    let targets = Targets {
        labels: &labelled,
        codes: &codes,
        weights: &weights,
        levels: levels as u32,
        width: width as u32,
    };
    let loss = device.buffer::<f32>("loss", PIXELS)?;
    let mut rec = Recorder::new(device, "self-check of the code loss");
    codes::record(&mut rec, &targets, frame, &loss);
    rec.run()?;
    let upstream = frame.planes_grad.read()?;
    let tolerance =
        Tolerance { relative_l2: 1e-6, absolute: 1e-5, relative: 1e-6, outliers: 0.0, outlier_factor: 1.0 };
    let mut distances = Vec::new();
    let mut expected = vec![0.0; PIXELS];
    for (level, labels) in labels.iter().enumerate() {
        let begin = (BASE_CHANNELS + level * width) * PIXELS;
        let range = begin..begin + width * PIXELS;
        let features = wide(&planes[range.clone()]);
        let (by_pixel, gradient) =
            codes::code_l1(labels, &wide(&table), width, level_weights[level].into(), &features);
        expected.iter_mut().zip(by_pixel).for_each(|(e, l)| *e += l);
        distances.push(close("gradient", &upstream[range], &gradient, &tolerance));
    }
    distances.push(close("loss", &loss.read()?, &expected, &tolerance));
    let others =
        equal("other gradients", &upstream[..BASE_CHANNELS * PIXELS], &[7.0; BASE_CHANNELS * PIXELS]);
    Ok(others.and(worst(distances)))
}

/// Every width that the shader is compiled for and one between; features of normal length and some
/// about as short as those without a code.
fn decode(device: &Device) -> Found {
    let cases = [(3, 9, 300), (8, 40, PIXELS), (16, 12, 290), (20, 11, 512), (24, 40, PIXELS)];
    each(cases, |(dim, count, pixels)| {
        let mut random = Random::new(24 + dim as u64);
        let mut normal = |n: usize| (0..n).map(|_| random.normal() as f32).collect::<Vec<f32>>();
        let mut codes = normal(count * dim);
        for code in codes.chunks_exact_mut(dim) {
            let norm = code.iter().map(|x| x * x).sum::<f32>().sqrt();
            code.iter_mut().for_each(|x| *x /= norm);
        }
        let mut planes = normal((dim + 2) * pixels);
        let length = |p: usize| if p.is_multiple_of(3) { 0.2 / (dim as f32).sqrt() } else { 1.0 };
        for plane in planes.chunks_exact_mut(pixels) {
            plane.iter_mut().enumerate().for_each(|(p, v)| *v *= length(p));
        }
        let alpha: Vec<f32> = (0..pixels).map(|p| (p % 11) as f32 / 10.0).collect();
        let features = device.buffer_from("features", &planes)?;
        let rest: Vec<f32> = alpha.iter().map(|a| 1.0 - a).collect();
        let transmittance = device.buffer_from("transmittance", &rest)?;
        let decoded = device.buffer::<i32>("decoded", pixels)?;
        let table = Codes::upload(device, &codes, dim)?;
        let mut rec = Recorder::new(device, "self-check of decoding");
        table.record(&mut rec, &features, 2, &transmittance, pixels as u32, &decoded);
        rec.run()?;
        let (mut reference, margin) = decode_pixels(&codes, dim, &planes[2 * pixels..], &alpha);
        let actual = decoded.read()?;
        for ((t, &a), margin) in reference.iter_mut().zip(&actual).zip(margin) {
            // Sums of at most 32 products in f32: nearly equal codes may win either way.
            if margin < 8e-6 {
                *t = a;
            }
        }
        Ok(equal("codes", &actual, &reference))
    })
}

/// Frames larger and smaller than the box of the search, with rows of more than one run.
fn query(device: &Device) -> Found {
    let mut random = Random::new(27);
    each([(SIZE, 12), ((37, 34), 6), ((9, 20), 300)], |((width, height), codes)| {
        // Blocks of 3 × 3 pixels of a code, one of a few none.
        let mut map = |count: usize| {
            let blocks: Vec<i32> = (0..width * height).map(|_| random.below(count + 1) as i32 - 1).collect();
            let data = (0..width * height).map(|p| blocks[p / width / 3 * width + p % width / 3]).collect();
            Image { width, height, data }
        };
        let frames: Vec<Arc<CodeMaps>> = (0..2)
            .map(|_| Ok(Arc::new(CodeMaps::new(&[codes, 3, codes].map(&mut map))?)))
            .collect::<crate::Result<_>>()?;
        let tables = [(codes, 28), (3, 29), (codes, 30)].map(|(n, seed)| Table::new(&noise(n, seed)));
        let shown = |frame: &CodeMaps, level: usize| -> Vec<u16> {
            frame.levels[level].shown.iter().map(|s| s.code).step_by(3).collect()
        };
        let answering: Vec<Vec<Vec<u16>>> =
            frames.iter().map(|f| vec![shown(f, 0), shown(f, 1), Vec::new()]).collect();
        let expected = HostSearch(&frames).search(&tables, &answering)?;
        let Some(mut search) = DeviceSearch::new(device, &frames, codes)? else {
            return Ok(Err("the device does not bind the sums of a small frame".to_owned()));
        };
        let words = |found: Vec<Vec<LevelPeaks>>| -> Vec<u32> {
            found.iter().flatten().flat_map(|f| [f.peak, f.location as u32]).collect()
        };
        Ok(equal("peaks", &words(search.search(&tables, &answering)?), &words(expected)))
    })
}

fn pack(device: &Device) -> Found {
    let dim = 6usize;
    let raster = Rasterizer::new(device, 1, dim, SIZE.0 as u32, SIZE.1 as u32)?;
    // Multiples of 1/64 are exact in half precision, and none lies between two 8-bit values.
    let planes: Vec<f32> =
        (0..(BASE_CHANNELS + dim) * PIXELS).map(|i| ((i * 7919 + 13) % 97) as f32 / 64.0).collect();
    let rest: Vec<f32> = (0..PIXELS).map(|i| (i % 9) as f32 / 8.0).collect();
    let frame = raster.frame();
    frame.planes.write(&planes)?;
    frame.transmittance.write(&rest)?;
    let encodings = [Encoding::Unorm8x4, Encoding::F16x4, Encoding::F32x4, Encoding::F32];
    let channels = [FrameChannel::Colour, FrameChannel::Alpha, FrameChannel::Features(1, 5)];
    let all = channels.into_iter().flat_map(|channel| encodings.map(|encoding| (channel, encoding)));
    each(all.chain([(FrameChannel::Depth, Encoding::F32)]), |(channel, encoding)| {
        let texels = pack::texels(device, PIXELS, channel, encoding)?;
        pack::pack(device, frame, &frame.bands.get(0), channel, encoding, &texels)?;
        let reference = pack::texels_of(&planes, &rest, channel, encoding);
        let actual = texels.cast::<u8>().read()?;
        Ok(match channel {
            FrameChannel::Depth => quotients(&actual, &reference),
            _ => equal("bytes", &actual, &reference),
        })
    })
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
fn plane_sweep(device: &Device) -> Found {
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
    let turns = [(0.0, 0.0, 0), (0.0, 0.0, 1), (0.1, 0.1, 0)];
    let turn = |r: &ReferenceView| {
        turns.map(|(geometric, smoothness, parity)| ReferenceView { geometric, smoothness, parity, ..*r })
    };
    for r in references.iter().flat_map(turn) {
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
