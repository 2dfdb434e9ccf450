//! Seeded scenes for tests and benchmarks.
use crate::math::Random;
use crate::scene::{Camera, Pose, Splats, sh_coefficients};
use glam::{DVec2, DVec3};

/// A pinhole camera with a focal length of 0.9 widths and a centred principal point.
pub fn camera(width: u32, height: u32, pose: Pose) -> Camera {
    let focal = 0.9 * f64::from(width);
    Camera {
        name: "seeded".into(),
        width,
        height,
        fx: focal,
        fy: focal,
        cx: f64::from(width) / 2.0,
        cy: f64::from(height) / 2.0,
        pose,
    }
}

/// Benchmark scene: N splats spread evenly over the image at depths 2–6, about 34–43 blended per
/// pixel at 50 000 splats and 480×360, whatever N and the size (the footprint shrinks with √N). The
/// camera is at the origin.
pub fn benchmark(n: usize, width: u32, height: u32, sh_degree: u32, seed: u64) -> (Splats, Camera) {
    let camera = camera(width, height, Pose::IDENTITY);
    let mut random = Random::new(seed);
    let footprint = 2.0 * (50_000.0 / n as f64).sqrt() * f64::from(width) / 480.0;
    let splats = scatter(&mut random, n, sh_degree, |random| {
        let pixel = DVec2::new(random.between(0.0, f64::from(width)), random.between(0.0, f64::from(height)));
        let depth = random.between(2.0, 6.0);
        (camera.unproject(pixel, depth), footprint * depth / camera.fx)
    });
    (splats, camera)
}

/// A small test scene around the view axis of an off-axis camera with an off-centre principal
/// point: every splat covers a few pixels, some lie beyond the image border.
pub fn small(n: usize, width: u32, height: u32, sh_degree: u32, seed: u64) -> (Splats, Camera) {
    let pose = Pose::exp(DVec3::new(0.1, -0.05, 0.2), DVec3::new(0.2, -0.3, 0.1));
    let mut camera = camera(width, height, pose);
    camera.fy *= 1.07;
    camera.cx -= 0.06 * f64::from(width);
    camera.cy += 0.05 * f64::from(height);
    let mut random = Random::new(seed);
    let splats = scatter(&mut random, n, sh_degree, |random| {
        let border = 0.15;
        let pixel = DVec2::new(
            random.between(-border, 1.0 + border) * f64::from(width),
            random.between(-border, 1.0 + border) * f64::from(height),
        );
        let depth = random.between(2.0, 5.0);
        (camera.unproject(pixel, depth), 0.08 * depth)
    });
    (splats, camera)
}

/// [N, d] standard normal features.
pub fn features(n: usize, dim: usize, seed: u64) -> Vec<f32> {
    let mut random = Random::new(seed ^ 0xF3A7);
    (0..n * dim).map(|_| random.scaled_normal(1.0) as f32).collect()
}

fn scatter(
    random: &mut Random,
    n: usize,
    sh_degree: u32,
    place: impl Fn(&mut Random) -> (DVec3, f64),
) -> Splats {
    let mut splats = Splats { sh_degree, ..Splats::default() };
    for _ in 0..n {
        let (mean, scale) = place(random);
        splats.means.push(mean.as_vec3().to_array());
        splats.log_scales.push([0; 3].map(|_| (scale.ln() + random.scaled_normal(0.35)) as f32));
        splats.quats.push([0; 4].map(|_| random.scaled_normal(1.0) as f32));
        splats.opacity_logits.push((random.scaled_normal(1.0) - 1.5) as f32);
        for k in 0..sh_coefficients(sh_degree) {
            let sigma = if k == 0 { 0.6 } else { 0.1 };
            splats.sh.extend([0; 3].map(|_| random.scaled_normal(sigma) as f32));
        }
    }
    splats
}
