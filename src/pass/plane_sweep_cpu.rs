//! The `plane_sweep` and `plane_sweep_refine` shaders on the host: slanted-plane multi-view matching.
//! It is the reference of the shaders, and faster than they are where the device is the processor.
//!
//! A hypothesis is the plane `π·X = 1` in the reference camera's frame, so that the inverse depth
//! along a pixel's ray is `1/z = π·ray` and the warp into a source view is the homography `K_s (R +
//! t πᵀ)`. Matching cost: 1 − bilaterally weighted ZNCC (Schönberger et al. 2016, eq. 7–8), mixed
//! over the best source views; propagation on a red-black checkerboard with adaptive candidate
//! areas (Xu and Tao 2019, ACMM, section 3.1).
use super::plane_sweep::{MAX_SOURCES, Matcher, ReferenceView, SourceView};
use super::sweep_window::{OFFSETS, OUTER, Quad, Warp, Window, moments};
use crate::Result;
use crate::gpu::shaders::shared::plane_sweep as shared;
use crate::math::hash;
use fearless_simd::{Level, Simd, dispatch};
use glam::{Vec2, Vec3, Vec4};
use rayon::prelude::*;

// Constants of glsl/shared/plane_sweep.glsl in the types of the reference.
const NEIGHBOURS: usize = shared::SMOOTH_NEIGHBOURS as usize;
const COST_LIMIT: f32 = shared::COST_LIMIT as f32;
const VARIANCE_FLOOR: f32 = shared::VARIANCE_FLOOR as f32;
const SIGMA_COLOUR: f32 = shared::SIGMA_COLOUR as f32;
const SIGMA_SPACE: f32 = shared::SIGMA_SPACE as f32;
const SMOOTH_LIMIT: f32 = shared::SMOOTH_LIMIT as f32;
const GEOMETRIC_LIMIT: f32 = shared::GEOMETRIC_LIMIT as f32;

/// Stream of hashed random numbers.
pub struct Random(pub u32);

impl Random {
    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f32 {
        self.0 = hash(self.0);
        (self.0 >> 8) as f32 / 16_777_216.0
    }
    /// Uniform in the cube [−1, 1)³.
    pub fn cube(&mut self) -> Vec3 {
        let x = self.uniform();
        let y = self.uniform();
        let z = self.uniform();
        Vec3::new(x, y, z) * 2.0 - Vec3::ONE
    }
}

/// Inputs of a pass.
pub struct Inputs<'a> {
    /// Luma of all views, one after the other.
    luma: &'a [f32],
    /// Luma of the sources, with the neighbours of each pixel.
    quads: &'a [Quad],
    /// Source views of all references.
    sources: &'a [SourceView],
    /// The reference and the search.
    reference: ReferenceView,
}

impl Inputs<'_> {
    /// Camera-frame ray (z = 1) through the centre of a pixel.
    pub fn ray(&self, x: i32, y: i32) -> Vec3 {
        let [fx, fy, cx, cy] = self.reference.intrinsics;
        Vec3::new((x as f32 + 0.5 - cx) / fx, (y as f32 + 0.5 - cy) / fy, 1.0)
    }

    /// Weights and moments of the window around a pixel; taps beyond the border repeat it.
    fn window(&self, x: i32, y: i32) -> Window {
        let r = &self.reference;
        let image = &self.luma[r.first as usize..];
        let luma_at = |x: i32, y: i32| {
            let (x, y) = (x.clamp(0, r.width as i32 - 1), y.clamp(0, r.height as i32 - 1));
            image[(y as u32 * r.width + x as u32) as usize]
        };
        let centre = luma_at(x, y);
        let (mut weights, mut values) = ([0.0; OUTER], [0.0; OUTER]);
        // The middle tap has weight 1 and value 0.
        let (mut sum, mut mean, mut square) = (1.0, 0.0, 0.0);
        for k in 0..OUTER {
            let (dx, dy) = (OFFSETS[0][k], OFFSETS[1][k]);
            // Relative to the centre, which keeps the variance exact in f32.
            let value = luma_at(x + dx as i32, y + dy as i32) - centre;
            let space = (dx * dx + dy * dy) / (2.0 * SIGMA_SPACE * SIGMA_SPACE);
            let weight = (-value.abs() / SIGMA_COLOUR - space).exp();
            weights[k] = weight;
            values[k] = value;
            sum += weight;
            mean += weight * value;
            square += weight * value * value;
        }
        mean /= sum;
        let mut centred = [0.0; OUTER];
        for k in 0..OUTER {
            weights[k] /= sum;
            centred[k] = weights[k] * (values[k] - mean);
        }
        Window { weights, centred, variance: (square / sum - mean * mean).max(0.0) }
    }

    /// 1 − ZNCC of the window warped by `plane` into one source view, at most `COST_LIMIT`.
    #[inline(always)]
    fn source_cost<S: Simd>(
        &self,
        simd: S,
        source: &SourceView,
        window: &Window,
        ray: Vec3,
        plane: Vec3,
    ) -> f32 {
        let rows = source.forward.map(Vec4::from);
        let [fx, fy, ..] = self.reference.intrinsics;
        let apply = |v: Vec4| Vec3::new(rows[0].dot(v), rows[1].dot(v), rows[2].dot(v));
        let centre = apply(ray.extend(plane.dot(ray)));
        let (u, v) = (centre.x / centre.z, centre.y / centre.z);
        let inside = u >= 0.0 && v >= 0.0 && u < source.size[0] as f32 && v < source.size[1] as f32;
        // The source must see the same side of the plane.
        let front = plane.dot(Vec4::from(source.centre).truncate()) < 1.0;
        if !(centre.z > 0.0 && inside && front) {
            return COST_LIMIT;
        }
        let along_x = apply(Vec4::new(1.0, 0.0, 0.0, plane.x)) / fx;
        let along_y = apply(Vec4::new(0.0, 1.0, 0.0, plane.y)) / fy;
        let [width, height, first, _] = source.size;
        let quads = &self.quads[first as usize..(first + width * height) as usize];
        let limit = [width, height].map(|n| n as f32 - 1.001);
        let (bx, by) = ((u - 0.5).clamp(0.0, limit[0]), (v - 0.5).clamp(0.0, limit[1]));
        let [top, right, below, diagonal] = quads[by as usize * width as usize + bx as usize];
        let (fx, fy) = (bx.fract(), by.fract());
        let (left, right) = (top + fy * (below - top), right + fy * (diagonal - right));
        let base = left + fx * (right - left);
        let warp = Warp { middle: centre, along_x, along_y };
        let [mean, square, covariance] = moments(simd, quads, width as usize, limit, base, &warp, window);
        let variance = (square - mean * mean).max(0.0);
        let scale = ((window.variance + VARIANCE_FLOOR) * (variance + VARIANCE_FLOOR)).sqrt();
        (1.0 - covariance / scale).min(COST_LIMIT)
    }

    /// Forward–backward reprojection error of the plane through a source view's present planes,
    /// pixels, at most [`GEOMETRIC_LIMIT`].
    fn geometric_error(
        &self,
        planes: &[Vec4],
        source: &SourceView,
        x: i32,
        y: i32,
        ray: Vec3,
        plane: Vec3,
    ) -> f32 {
        let apply = |rows: &[[f32; 4]; 3], v: Vec4| {
            Vec3::new(Vec4::from(rows[0]).dot(v), Vec4::from(rows[1]).dot(v), Vec4::from(rows[2]).dot(v))
        };
        let q = apply(&source.forward, ray.extend(plane.dot(ray)));
        let (u, v) = (q.x / q.z, q.y / q.z);
        let [width, height, first, _] = source.size;
        if !(q.z > 0.0 && u >= 0.0 && v >= 0.0 && u < width as f32 && v < height as f32) {
            return GEOMETRIC_LIMIT;
        }
        let other = planes[first as usize + v as usize * width as usize + u as usize].truncate();
        let [fx, fy, cx, cy] = source.intrinsics;
        let ray_s = Vec3::new((u - cx) / fx, (v - cy) / fy, 1.0);
        let p = apply(&source.back, ray_s.extend(other.dot(ray_s)));
        if p.z <= 0.0 {
            return GEOMETRIC_LIMIT;
        }
        let error = Vec2::new(p.x / p.z - x as f32 - 0.5, p.y / p.z - y as f32 - 0.5);
        error.length().min(GEOMETRIC_LIMIT)
    }

    /// Aggregated cost of a plane at a pixel: the sorted source costs mixed by
    /// [`shared::VIEW_SHARES`].
    #[inline(always)]
    fn cost<S: Simd>(
        &self,
        simd: S,
        planes: &[Vec4],
        window: &Window,
        [x, y]: [i32; 2],
        ray: Vec3,
        plane: Vec3,
    ) -> f32 {
        let r = &self.reference;
        let mut best = [COST_LIMIT + r.geometric * GEOMETRIC_LIMIT; MAX_SOURCES];
        for source in &self.sources[r.first_source as usize..(r.first_source + r.sources) as usize] {
            let mut cost = self.source_cost(simd, source, window, ray, plane);
            if r.geometric > 0.0 {
                cost += r.geometric * self.geometric_error(planes, source, x, y, ray, plane);
            }
            // Insertion into the sorted list; the last entry is dropped.
            for slot in &mut best {
                if cost < *slot {
                    std::mem::swap(slot, &mut cost);
                }
            }
        }
        (0..MAX_SOURCES).map(|k| shared::VIEW_SHARES[k] as f32 * best[k]).sum()
    }

    /// Plane through `1/z = inverse_depth` at the pixel with a given normal; `None` if it is seen
    /// too obliquely or lies outside the searched range.
    pub fn plane(&self, ray: Vec3, normal: Vec3, inverse_depth: f32) -> Option<Vec3> {
        let slope = normal.dot(ray);
        let [near, far] = [self.reference.range[1], self.reference.range[0]];
        // cos 84°: a window foreshortened tenfold has no matches.
        let visible = slope < -0.1 * normal.length() * ray.length();
        (visible && inverse_depth >= far && inverse_depth <= near).then(|| normal * (inverse_depth / slope))
    }

    /// Random number stream of a pixel.
    pub fn random(&self, x: i32, y: i32) -> Random {
        let r = &self.reference;
        Random(hash(r.seed ^ hash(r.first + y as u32 * r.width + x as u32)))
    }

    /// Initial sweep at one pixel: `planes` inverse depths over the range, jittered, each with a
    /// random normal (cosine-weighted about the viewing ray). Returns the best plane and its cost.
    #[inline(always)]
    fn sweep<S: Simd>(&self, simd: S, x: i32, y: i32) -> Vec4 {
        let r = &self.reference;
        let ray = self.ray(x, y);
        let window = self.window(x, y);
        let mut random = self.random(x, y);
        let view = ray.normalize();
        let mut best = (-view * (r.range[0] / -view.dot(ray))).extend(f32::MAX);
        for k in 0..r.planes {
            let share = (k as f32 + random.uniform()) / r.planes as f32;
            let inverse_depth = r.range[0] + share * (r.range[1] - r.range[0]);
            let normal = random.cube() * 0.9 - view;
            let Some(plane) = self.plane(ray, normal, inverse_depth) else { continue };
            let cost = self.cost(simd, &[], &window, [x, y], ray, plane);
            if cost < best.w {
                best = plane.extend(cost);
            }
        }
        best
    }

    /// Neighbours of the smoothness term of a pixel: (offset, inverse depth, weight).
    fn neighbours(&self, own: &[Vec4], x: i32, y: i32) -> [([i32; 2], f32, f32); NEIGHBOURS] {
        let r = &self.reference;
        let luma = |x: i32, y: i32| self.luma[(r.first + y as u32 * r.width + x as u32) as usize];
        std::array::from_fn(|n| {
            let step = if n < 4 { 1 } else { 3 };
            let along = (1 - 2 * (n as i32 & 1)) * step;
            let [dx, dy] = if n & 2 == 0 { [along, 0] } else { [0, along] };
            let (px, py) = (x + dx, y + dy);
            if px < 0 || py < 0 || px >= r.width as i32 || py >= r.height as i32 {
                return ([dx, dy], 1.0, 0.0);
            }
            let difference = (luma(px, py) - luma(x, y)).abs();
            let weight = (-difference / SIGMA_COLOUR).exp() * r.smoothness / NEIGHBOURS as f32;
            let plane = own[(py as u32 * r.width + px as u32) as usize].truncate();
            ([dx, dy], plane.dot(self.ray(px, py)), weight)
        })
    }

    /// Smoothness term: weighted differences of inverse depth between a plane and the neighbours.
    fn roughness(&self, near: &[([i32; 2], f32, f32); NEIGHBOURS], x: i32, y: i32, plane: Vec3) -> f32 {
        let difference = |&([dx, dy], inverse, weight): &([i32; 2], f32, f32)| {
            let extended = plane.dot(self.ray(x + dx, y + dy));
            weight * ((extended - inverse).abs() / (SMOOTH_LIMIT * inverse.max(1e-9))).min(1.0)
        };
        near.iter().map(difference).sum()
    }

    /// One propagation and refinement step at one pixel. `planes` holds (π, cost) of all views.
    #[inline(always)]
    fn refine<S: Simd>(&self, simd: S, planes: &[Vec4], x: i32, y: i32) -> Vec4 {
        let r = &self.reference;
        let own = &planes[r.first as usize..];
        let ray = self.ray(x, y);
        let window = self.window(x, y);
        let near = self.neighbours(own, x, y);
        // A function of its own, since it is called at several places.
        let total = |plane: Vec3| {
            simd.vectorize(
                #[inline(always)]
                || self.cost(simd, planes, &window, [x, y], ray, plane) + self.roughness(&near, x, y, plane),
            )
        };
        let mut random = self.random(x, y);
        let current = own[(y as u32 * r.width + x as u32) as usize];
        // Re-evaluated, since a change of resolution or of the other views makes the stored cost
        // stale.
        let cost = total(current.truncate());
        let mut best = current.truncate().extend(cost);
        // Neighbours often share a plane; its cost is known.
        let (mut tried, mut count) = ([current.truncate(); 9], 1);
        for area in 0..8 {
            let Some(candidate) = self.area_best(own, x, y, area) else { continue };
            let inverse_depth = candidate.dot(ray);
            let known = tried[..count].contains(&candidate);
            if inverse_depth < r.range[0] || inverse_depth > r.range[1] || known {
                continue;
            }
            (tried[count], count) = (candidate, count + 1);
            let cost = total(candidate);
            if cost < best.w {
                best = candidate.extend(cost);
            }
        }
        for trial in 0..4 {
            let plane = best.truncate();
            let inverse_depth = plane.dot(ray);
            let normal = -plane.normalize();
            // Log-uniform step lengths replace an annealing schedule: 10 % down to 0.02 % of the
            // depth.
            let depth_step = 0.1 * (-9.0 * random.uniform()).exp2();
            let normal_step = 0.7 * (-5.0 * random.uniform()).exp2();
            let moved = inverse_depth * (1.0 + depth_step * (2.0 * random.uniform() - 1.0));
            let turned = normal + random.cube() * normal_step;
            let (normal, inverse_depth) = match trial {
                0 => (normal, moved),
                1 => (turned, inverse_depth),
                2 => (turned, moved),
                _ => {
                    let share = random.uniform();
                    let wild = r.range[0] + share * (r.range[1] - r.range[0]);
                    (random.cube() * 0.9 - ray.normalize(), wild)
                }
            };
            let Some(candidate) = self.plane(ray, normal, inverse_depth) else { continue };
            let cost = total(candidate);
            if cost < best.w {
                best = candidate.extend(cost);
            }
        }
        best
    }

    /// Plane with the lowest cost in one of eight areas around a pixel (0–3: a near wedge per
    /// direction, 4–7: a far strip per direction), all of the other checkerboard colour; `None`
    /// where the area is outside the image.
    pub fn area_best(&self, own: &[Vec4], x: i32, y: i32, area: usize) -> Option<Vec3> {
        let r = &self.reference;
        let (dx, dy) = [(1, 0), (-1, 0), (0, 1), (0, -1)][area % 4];
        let mut best: Option<Vec4> = None;
        let mut consider = |x: i32, y: i32| {
            if x >= 0 && y >= 0 && x < r.width as i32 && y < r.height as i32 {
                let candidate = own[(y as u32 * r.width + x as u32) as usize];
                if best.is_none_or(|b| candidate.w < b.w) {
                    best = Some(candidate);
                }
            }
        };
        if area < 4 {
            consider(x + dx, y + dy);
            for side in [-1, 1] {
                consider(x + 2 * dx + side * dy, y + 2 * dy + side * dx);
                consider(x + 3 * dx + 2 * side * dy, y + 3 * dy + 2 * side * dx);
            }
        } else {
            for step in 0..8 {
                consider(x + (5 + 2 * step) * dx, y + (5 + 2 * step) * dy);
            }
        }
        best.map(|b| b.truncate())
    }
}

/// Matcher on the host.
pub struct CpuMatcher {
    luma: Vec<f32>,
    quads: Vec<Quad>,
    sources: Vec<SourceView>,
    planes: Vec<Vec4>,
}

impl CpuMatcher {
    /// Takes `luma` and `planes` (π, cost) of all views, one after the other.
    pub fn new(luma: Vec<f32>, sources: Vec<SourceView>, planes: Vec<Vec4>) -> Self {
        let mut quads = vec![[0.0; 4]; luma.len()];
        let mut done = Vec::new();
        for source in &sources {
            let [width, height, first] = [0, 1, 2].map(|k| source.size[k] as usize);
            if done.contains(&first) {
                continue;
            }
            done.push(first);
            let image = &luma[first..first + width * height];
            let own = quads[first..first + width * height].par_iter_mut().with_min_len(4096).enumerate();
            own.for_each(|(k, quad)| {
                let (x, y) = (k % width, k / width);
                let (right, below) = ((x + 1).min(width - 1), (y + 1).min(height - 1) * width);
                *quad = [image[k], image[y * width + right], image[below + x], image[below + right]];
            });
        }
        CpuMatcher { luma, quads, sources, planes }
    }
}

impl CpuMatcher {
    fn inputs(&self, reference: &ReferenceView) -> Inputs<'_> {
        let CpuMatcher { luma, quads, sources, .. } = self;
        Inputs { luma, quads, sources, reference: *reference }
    }
}

impl Matcher for CpuMatcher {
    fn sweep(&mut self, reference: &ReferenceView) -> Result<()> {
        let (width, first) = (reference.width as usize, reference.first as usize);
        let inputs = self.inputs(reference);
        let (pixels, level) = (width * reference.height as usize, Level::new());
        let swept: Vec<Vec4> = (0..pixels)
            .into_par_iter()
            .map(|k| dispatch!(level, simd => inputs.sweep(simd, (k % width) as i32, (k / width) as i32)))
            .collect();
        self.planes[first..first + pixels].copy_from_slice(&swept);
        Ok(())
    }
    fn refine(&mut self, reference: &ReferenceView) -> Result<()> {
        let (width, first) = (reference.width as usize, reference.first as usize);
        let inputs = self.inputs(reference);
        let of_colour = |k: &usize| (k % width + k / width) % 2 == reference.parity as usize;
        let pixels = width * reference.height as usize;
        let active: Vec<usize> = (0..pixels).filter(of_colour).collect();
        let planes = &self.planes;
        let level = Level::new();
        let updated: Vec<Vec4> = active
            .par_iter()
            .map(|&k| {
                let (x, y) = ((k % width) as i32, (k / width) as i32);
                dispatch!(level, simd => inputs.refine(simd, planes, x, y))
            })
            .collect();
        for (k, plane) in active.into_iter().zip(updated) {
            self.planes[first + k] = plane;
        }
        Ok(())
    }
    fn planes(&self) -> Result<Vec<Vec4>> {
        Ok(self.planes.clone())
    }
}
