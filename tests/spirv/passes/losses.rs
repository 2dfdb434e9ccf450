//! Losses, regularisers and the optimiser.
use splatvk::gpu::{Device, Recorder};
use splatvk::math::Random;
use splatvk::pass::Rasterizer;
use splatvk::pass::adam::{self as optimiser, Class, Moments, Schedule};
use splatvk::pass::bands::Bands;
use splatvk::pass::codes::{self as language, Targets};
use splatvk::pass::regularise::{
    RatioPenalty, alpha_l1, depth_l1, ratio_penalty, record_alpha, record_depth, record_ratio,
};
use splatvk::pass::ssim_l1::{self as image_loss, SsimRowKernel};

fn normal(n: usize, seed: u64) -> Vec<f32> {
    let mut random = Random::new(seed);
    (0..n).map(|_| random.scaled_normal(1.0) as f32).collect()
}

fn uniform(n: usize, low: f64, seed: u64) -> Vec<f32> {
    let mut random = Random::new(seed);
    (0..n).map(|_| random.between(low, low + 1.0) as f32).collect()
}

fn wide(v: &[f32]) -> Vec<f64> {
    v.iter().map(|&a| f64::from(a)).collect()
}

pub fn depth(device: &Device) {
    let (width, height) = (13u32, 9u32);
    let pixels = (width * height) as usize;
    let raster = Rasterizer::new(device, 1, 0, width, height).unwrap();
    let frame = raster.frame();
    let (depth, see_through) = (uniform(pixels, 0.0, 1060), uniform(pixels, 0.0, 1061));
    let mut reference = uniform(pixels, 0.5, 1062);
    reference[7] = 0.0;
    frame.planes.write_at(3 * pixels, &depth).unwrap();
    frame.transmittance.write(&see_through).unwrap();
    let buffer = device.buffer_from("reference", &reference).unwrap();
    let record = |reference, weight| {
        let mut rec = Recorder::new(device, "depth");
        record_depth(&mut rec, frame, reference, weight);
        rec.run().unwrap();
        frame.planes_grad.read().unwrap()
    };
    let upstream = record(Some(&buffer), 0.25);
    let alpha: Vec<f64> = see_through.iter().map(|t| 1.0 - f64::from(*t)).collect();
    let (_, gradient) = depth_l1(&wide(&depth), &alpha, &wide(&reference), 0.25);
    for (i, expected) in gradient.iter().enumerate() {
        for (k, expected) in expected.iter().enumerate() {
            let got = f64::from(upstream[(3 + k) * pixels + i]);
            assert!((got - expected).abs() < 1e-6, "pixel {i}: {got} {expected}");
        }
    }
    assert!(record(None, 0.0).iter().all(|&g| g == 0.0));
    let mut wanted = uniform(pixels, 0.0, 1064);
    wanted[5] = -1.0;
    let buffer = device.buffer_from("wanted", &wanted).unwrap();
    let mut rec = Recorder::new(device, "alpha");
    record_alpha(&mut rec, frame, &buffer, 0.25);
    rec.run().unwrap();
    let upstream = frame.planes_grad.read().unwrap();
    let (_, gradient) = alpha_l1(&alpha, &wide(&wanted), 0.25);
    assert_eq!(wide(&upstream[4 * pixels..]), gradient);
}

pub fn ratio(device: &Device) {
    let rows: Vec<f32> = normal(3 * 97, 1063).iter().map(|x| 2.0 * x).collect();
    let log_scales = device.buffer_from("log scales", &rows).unwrap();
    let gradients = device.buffer_from("gradients", &[1.0f32; 3 * 97]).unwrap();
    let mut rec = Recorder::new(device, "ratio");
    record_ratio(&mut rec, &log_scales, &gradients, 97, RatioPenalty { weight: 0.5, limit: 8.0 });
    rec.run().unwrap();
    for (row, got) in rows.chunks_exact(3).zip(gradients.read().unwrap().chunks_exact(3)) {
        let (_, gradient) = ratio_penalty([0, 1, 2].map(|k| f64::from(row[k])), 0.5, 8.0);
        for k in 0..3 {
            assert!((f64::from(got[k]) - 1.0 - gradient[k]).abs() < 1e-5 * (1.0 + gradient[k].abs()));
        }
    }
}

pub fn adam(device: &Device) {
    let (rows, stride, head, rates) = (41usize, 9usize, 3usize, [2e-3, 1e-4]);
    let count = rows * stride;
    let start = normal(count, 1064);
    let parameters = device.buffer_from("p", &start).unwrap();
    let gradients = device.buffer::<f32>("g", count).unwrap();
    let moments = Moments::new(device, count).unwrap();
    let guard = device.buffer::<u32>("guard", 2).unwrap();
    let mut schedule = Schedule::new(device, 2).unwrap();
    let (mut reference, mut state) = (wide(&start), vec![[0.0; 2]; count]);
    for step in 1..=4 {
        let mut g = normal(count, 1065 + step as u64);
        g[5] = f32::NAN;
        gradients.write(&g).unwrap();
        schedule.set(step, &[[0.0; 2], rates]).unwrap();
        let mut rec = Recorder::new(device, "adam");
        let class = Class { slot: 1, count, stride: stride as u32, head: head as u32 };
        schedule.record(&mut rec, class, &parameters, &gradients, &moments, &guard);
        rec.run().unwrap();
        for i in 0..count {
            let rate = rates[usize::from(i % stride >= head)];
            let range = i..i + 1;
            optimiser::adam(
                &mut reference[range.clone()],
                &[f64::from(g[i])],
                &mut state[range],
                rate,
                optimiser::EPSILON,
                step,
            );
        }
    }
    for (i, (p, t)) in parameters.read().unwrap().into_iter().zip(&reference).enumerate() {
        // As in src/pass/adam.rs.
        assert!((f64::from(p) - t).abs() < 2e-6, "{i}: {p} {t}");
    }
    assert_eq!(schedule.faults().unwrap(), 4);
}

pub fn codes(device: &Device) {
    let (levels, width, count, side) = (2usize, 5usize, 4usize, [23u32, 7]);
    let pixels = (side[0] * side[1]) as usize;
    let raster = Rasterizer::new(device, 1, levels * width, side[0], side[1]).unwrap();
    let frame = raster.frame();
    let mut random = Random::new(1070);
    let labels: Vec<i32> = (0..levels * pixels)
        .map(|k| {
            let label = (random.bits() % (count as u64 + 1)) as i32 - 1;
            if label >= 0 && k >= pixels { label + count as i32 } else { label }
        })
        .collect();
    let table = normal(2 * count * width, 1071);
    let planes = normal((4 + levels * width) * pixels, 1072);
    let weights = [0.5f32, 0.25];
    frame.planes.write(&planes).unwrap();
    let held = (
        device.buffer_from("labels", &labels).unwrap(),
        device.buffer_from("codes", &table).unwrap(),
        device.buffer_from("weights", &weights).unwrap(),
    );
    let targets = Targets {
        labels: &held.0,
        codes: &held.1,
        weights: &held.2,
        levels: levels as u32,
        width: width as u32,
    };
    let loss = device.buffer::<f32>("loss", pixels).unwrap();
    // Only the gradients of the codes change.
    frame.planes_grad.write(&vec![7.0; (5 + levels * width) * pixels]).unwrap();
    let mut rec = Recorder::new(device, "codes");
    language::record(&mut rec, &targets, frame, &loss);
    rec.run().unwrap();
    let upstream = frame.planes_grad.read().unwrap();
    assert!(upstream[..4 * pixels].iter().all(|g| *g == 7.0));
    let mut expected = vec![0.0; pixels];
    for level in 0..levels {
        let range = (4 + level * width) * pixels..(4 + (level + 1) * width) * pixels;
        let labels = &labels[level * pixels..(level + 1) * pixels];
        let (part, gradient) = language::code_l1(
            labels,
            &wide(&table),
            width,
            f64::from(weights[level]),
            &wide(&planes[range.clone()]),
        );
        expected.iter_mut().zip(part).for_each(|(e, p)| *e += p);
        assert_eq!(wide(&upstream[range]), gradient);
    }
    assert!(loss.read().unwrap().iter().zip(&expected).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-5));
}

pub fn ssim_l1(device: &Device) {
    let sizes = [(13, 7), (70, 18)];
    let cases = sizes.into_iter().flat_map(|s| [(s, SsimRowKernel::Strips), (s, SsimRowKernel::Shared)]);
    for ((w, h), rows, weighted) in cases.flat_map(|(s, r)| [(s, r, false), (s, r, true)]) {
        let weight = |i: usize| if weighted { [0.0f32, 1.0, 0.25][(i % w / 4 + i / w / 3) % 3] } else { 1.0 };
        let weights: Vec<f32> = (0..w * h).map(weight).collect();
        let covered = weighted.then(|| wide(&weights).iter().sum::<f64>());
        let (x, noise) = (uniform(3 * w * h, 0.0, 1073), uniform(3 * w * h, 0.0, 1074));
        let y: Vec<f32> = x.iter().zip(&noise).map(|(x, n)| 0.7 * x + 0.3 * n).collect();
        let (expected, gradient) =
            image_loss::ssim_l1_weighted(&wide(&x), &wide(&y), &wide(&weights), w, h, 0.8, 0.2);
        let bands = Bands::whole(w, h);
        let pass = image_loss::SsimL1::with(device, std::slice::from_ref(&bands), rows).unwrap();
        let rendered = device.buffer_from("x", &x).unwrap();
        let stack = if weighted { [&y[..], &weights].concat() } else { y.clone() };
        let target = device.buffer_from("y", &stack).unwrap();
        let out = device.buffer::<f32>("gradient", 3 * w * h).unwrap();
        let sums = device.buffer::<f32>("loss", 4).unwrap();
        let mut rec = Recorder::new(device, "ssim");
        let band = (&bands, &bands.get(0));
        pass.record(&mut rec, band, &rendered, &target, &out, covered, [0.8, 0.2], (&sums, 1));
        rec.run().unwrap();
        let sums = sums.read().unwrap();
        let loss = image_loss::ImageLoss::of(&bands, [sums[1], sums[2]].map(f64::from), covered);
        // Tolerances of src/pass/ssim_l1.rs.
        assert!((loss.l1 - expected.l1).abs() < 1e-5 && (loss.ssim - expected.ssim).abs() < 1e-5);
        let scale = gradient.iter().fold(0.0f64, |m, g| m.max(g.abs()));
        for (g, e) in out.read().unwrap().into_iter().zip(gradient) {
            assert!((f64::from(g) - e).abs() < 1e-3 * scale, "{w}x{h}: {g} {e}");
        }
    }
}
