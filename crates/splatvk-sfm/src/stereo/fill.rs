//! Depth where matching fails (weak texture, visible in one view, depth edges): planes of
//! consistent pixels spread along paths of similar colour, outside the free space of other views.
use super::Level;
use super::colours::ColourModel;
use super::planes::WorldPlane;
use super::surface::{RelativePoses, Surface, Visibility, free_space_tolerance, neighbours, ray};
use glam::Vec3;
use rayon::prelude::*;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Path cost per pixel of constant colour; RGB differences (Euclidean) are added, so that an edge
/// of 5 grey levels costs as much as 4 pixels.
const STEP: f32 = 0.005;
/// Factor on the path cost of a local plane, compared with one of the scene's large planes.
const LOCAL_FACTOR: f32 = 2.0;
/// Factor on the path cost over colours that never occur on the large plane, less [`OWN_COLOUR`].
const FOREIGN_COLOUR: f32 = 3.0;
/// Factor on the path cost over colours that occur only on the large plane: its texture is no edge.
const OWN_COLOUR: f32 = 0.1;
/// Path cost of a pixel at which the plane lies in the free space of another view.
const FREE_SPACE_COST: f32 = 0.3;
/// RGB distance (Euclidean) up to which two views show the same point: gloss and exposure change
/// colours as much.
pub const COLOUR_TOLERANCE: f32 = 0.2;
/// Factor on a pixel's path cost where another view agrees with the plane.
const CONFIRMED: f32 = 0.3;
/// Highest confidence of a filled pixel, below every matched one.
const FILLED_CONFIDENCE: f32 = 0.3;
/// Path cost at which the confidence of a filled pixel is halved.
const HALF_CONFIDENCE_COST: f32 = 0.5;

/// Rejects consistent pixels within `radius` of a depth step: there the matching window mixes two
/// surfaces, and filling locates the colour edge more exactly.
pub fn without_depth_edges(level: &Level, surface: &Surface, radius: usize) -> Surface {
    let of_view = |view| confidence_off_edges(level, surface, view, radius);
    let confidence = (0..level.references.len()).into_par_iter().flat_map_iter(of_view).collect();
    Surface { planes: surface.planes.clone(), confidence }
}

/// Confidence of the pixels of one view, 0 near its depth steps.
fn confidence_off_edges(level: &Level, surface: &Surface, view: usize, radius: usize) -> Vec<f32> {
    let r = &level.references[view];
    let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
    let depth = super::surface::depth(level, view, surface);
    let tolerance = free_space_tolerance(level, view);
    let mut confidence = surface.confidence[first..first + width * height].to_vec();
    for y in 0..height {
        for x in 0..width {
            let z = depth.at(x, y);
            let differs = |n: usize| depth.data[n] > 0.0 && (depth.data[n] - z).abs() > tolerance * z;
            if z <= 0.0 || !neighbours(y * width + x, width, height).any(differs) {
                continue;
            }
            for py in y.saturating_sub(radius)..(y + radius + 1).min(height) {
                let row = py * width;
                confidence[row + x.saturating_sub(radius)..row + (x + radius + 1).min(width)].fill(0.0);
            }
        }
    }
    confidence
}

/// Assigns a plane to every pixel that is not void. `surface` holds the consistent pixels, with
/// smoothed planes.
pub fn fill(
    level: &Level,
    poses: &RelativePoses,
    surface: &Surface,
    large: &[WorldPlane],
    void: &[bool],
) -> Surface {
    let views: Vec<(Vec<Vec3>, Vec<f32>)> = (0..level.cameras.len())
        .into_par_iter()
        .map(|view| ViewFill::new(level, poses, surface, void, view).run(large))
        .collect();
    let mut out = Surface { planes: Vec::new(), confidence: Vec::new() };
    for (planes, confidence) in views {
        out.planes.extend(planes);
        out.confidence.extend(confidence);
    }
    out
}

/// Cheapest paths to the pixels of one view.
struct Paths {
    /// Pixel at which the path starts; `u32::MAX` = unreached.
    source: Vec<u32>,
    cost: Vec<f32>,
}

struct ViewFill<'a> {
    level: &'a Level,
    poses: &'a RelativePoses,
    surface: &'a Surface,
    void: &'a [bool],
    view: usize,
    width: usize,
    height: usize,
    first: usize,
}

impl<'a> ViewFill<'a> {
    fn new(
        level: &'a Level,
        poses: &'a RelativePoses,
        surface: &'a Surface,
        void: &'a [bool],
        view: usize,
    ) -> Self {
        let r = &level.references[view];
        let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
        ViewFill { level, poses, surface, void, view, width, height, first }
    }

    fn run(&self, large: &[WorldPlane]) -> (Vec<Vec3>, Vec<f32>) {
        let pixels = self.width * self.height;
        let own = self.first..self.first + pixels;
        let mut planes = self.surface.planes[own.clone()].to_vec();
        let mut confidence = self.surface.confidence[own.clone()].to_vec();
        let mut best = vec![f32::INFINITY; pixels];
        let consistent: Vec<u32> =
            (0..pixels as u32).filter(|&k| self.surface.confidence[self.first + k as usize] > 0.0).collect();
        let plane_of = |source: usize| self.surface.planes[self.first + source];
        let (local, extended) = rayon::join(
            || self.propagate(&consistent, None, None),
            || large.par_iter().map(|plane| self.extend(plane, &consistent)).collect::<Vec<_>>(),
        );
        self.take_cheaper(&local, LOCAL_FACTOR, plane_of, &mut best, &mut planes);
        for (plane, paths) in extended.into_iter().flatten() {
            self.take_cheaper(&paths, 1.0, |_| plane, &mut best, &mut planes);
        }
        for k in 0..pixels {
            if self.void[self.first + k] || (confidence[k] <= 0.0 && !best[k].is_finite()) {
                confidence[k] = 0.0;
            } else if confidence[k] <= 0.0 {
                confidence[k] = FILLED_CONFIDENCE / (1.0 + best[k] / HALF_CONFIDENCE_COST);
            }
        }
        (planes, confidence)
    }

    /// Paths of a large plane, in the camera's frame, from the `consistent` pixels on it; `None`
    /// where these are too few.
    fn extend(&self, plane: &WorldPlane, consistent: &[u32]) -> Option<(Vec3, Paths)> {
        let plane = plane.in_camera(&self.level.cameras[self.view])?;
        let on: Vec<u32> = consistent.iter().copied().filter(|&k| self.lies_on(k as usize, plane)).collect();
        // A few pixels that touch the plane by chance must not extend it over the image.
        if on.len() * 1000 < self.width * self.height {
            return None;
        }
        let colours = ColourModel::new(&self.level.guide[self.view], &on, consistent);
        Some((plane, self.propagate(&on, Some(plane), Some(&colours))))
    }

    /// Assigns the planes of paths whose cost times `factor` is below the best so far.
    fn take_cheaper(
        &self,
        paths: &Paths,
        factor: f32,
        plane: impl Fn(usize) -> Vec3,
        best: &mut [f32],
        planes: &mut [Vec3],
    ) {
        for k in 0..best.len() {
            let (source, cost) = (paths.source[k], paths.cost[k] * factor);
            if self.surface.confidence[self.first + k] <= 0.0 && cost < best[k] && source != u32::MAX {
                best[k] = cost;
                planes[k] = plane(source as usize);
            }
        }
    }

    fn ray(&self, k: usize) -> Vec3 {
        ray(self.level, self.view, k % self.width, k / self.width)
    }

    fn lies_on(&self, k: usize, plane: Vec3) -> bool {
        let ray = self.ray(k);
        let here = self.surface.planes[self.first + k].dot(ray);
        (plane.dot(ray) - here).abs() < 0.5 * self.level.tolerance[self.view] * here
    }

    /// Dijkstra's algorithm from the pixels `sources` over the rejected pixels. Paths carry `plane`
    /// or else the plane of their source.
    fn propagate(&self, sources: &[u32], plane: Option<Vec3>, colours: Option<&ColourModel>) -> Paths {
        let pixels = self.width * self.height;
        let mut cost = vec![f32::INFINITY; pixels];
        let mut source = vec![u32::MAX; pixels];
        let mut heap = BinaryHeap::new();
        for &k in sources {
            cost[k as usize] = 0.0;
            source[k as usize] = k;
            heap.push((Reverse(0u32), k));
        }
        let [far, near] = self.level.references[self.view].range;
        let guide = &self.level.guide[self.view];
        while let Some((Reverse(bits), k)) = heap.pop() {
            let k = k as usize;
            // Bit patterns of non-negative floats sort like the floats.
            let here = f32::from_bits(bits);
            if here > cost[k] {
                continue;
            }
            for n in neighbours(k, self.width, self.height) {
                if cost[n] <= here
                    || self.surface.confidence[self.first + n] > 0.0
                    || self.void[self.first + n]
                {
                    continue;
                }
                let (a, b) = (guide.data[k], guide.data[n]);
                let difference = (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f32>().sqrt();
                let candidate = plane.unwrap_or(self.surface.planes[self.first + source[k] as usize]);
                let inverse = candidate.dot(self.ray(n));
                // More than a factor of two beyond the searched range: a useless extrapolation.
                if inverse < 0.5 * far || inverse > 2.0 * near {
                    continue;
                }
                // Up to three times the cost for other colours, a tenth for the plane's own.
                let foreign =
                    colours.map_or(1.0, |c| FOREIGN_COLOUR * (1.0 - c.share(b)).powi(2) + OWN_COLOUR);
                // Evidence lowers the cost by this factor at most.
                if here + (STEP + difference) * CONFIRMED * foreign >= cost[n] {
                    continue;
                }
                let evidence = self.evidence(n, candidate);
                let total = here + (STEP + difference) * evidence.0 * foreign + evidence.1;
                if total < cost[n] {
                    cost[n] = total;
                    source[n] = source[k];
                    heap.push((Reverse(total.to_bits()), n as u32));
                }
            }
        }
        Paths { source, cost }
    }

    /// Factor and addend on the path cost from the visibility in the other views.
    fn evidence(&self, k: usize, plane: Vec3) -> (f32, f32) {
        let (x, y) = (k % self.width, k / self.width);
        let ray = self.ray(k);
        let point = ray / plane.dot(ray);
        let mut evidence = (1.0, 0.0);
        for other in self.level.neighbours(self.view) {
            let pixel = [x as f32 + 0.5, y as f32 + 0.5];
            match self.poses.visibility(self.level, self.surface, self.view, other, pixel, point) {
                Visibility::FreeSpace => evidence.1 = FREE_SPACE_COST,
                Visibility::Agrees => {
                    if self.same_colour(x, y, other, point) {
                        evidence.0 = CONFIRMED;
                    } else {
                        evidence.1 = FREE_SPACE_COST;
                    }
                }
                _ => {}
            }
        }
        evidence
    }

    /// True if the other view shows the point in a similar colour, or not at all.
    fn same_colour(&self, x: usize, y: usize, other: usize, point: Vec3) -> bool {
        let Some((u, v, _)) = self.poses.project(self.level, self.view, other, point) else { return true };
        let here = self.level.guide[self.view].at(x, y);
        let there = self.level.guide[other].at(u as usize, v as usize);
        (0..3).map(|c| (here[c] - there[c]).powi(2)).sum::<f32>().sqrt() < COLOUR_TOLERANCE
    }
}
