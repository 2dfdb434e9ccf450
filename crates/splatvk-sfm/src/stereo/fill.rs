//! Depth where matching fails (weak texture, in one view only, rims of objects): the planes of
//! consistent pixels are carried on along paths of similar colour, never into space that another
//! view sees through.
use super::Level;
use super::colours::ColourModel;
use super::planes::WorldPlane;
use super::surface::{RelativePoses, Surface, Visibility, free_space, neighbours, ray};
use glam::Vec3;
use rayon::prelude::*;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Cost of one pixel of path over constant colour; colour differences (RGB, Euclidean) are added,
/// so that an edge of 5 grey levels weighs as much as 4 pixels.
const STEP: f32 = 0.005;
/// A locally fitted plane is carried on this much more reluctantly than one of the scene's large
/// planes.
const LOCAL_RELUCTANCE: f32 = 2.0;
/// Factor on the path cost over colours that never occur on the large plane, less [`OWN`].
const FOREIGN: f32 = 3.0;
/// Factor on the path cost over colours that occur only on the large plane: texture of the plane is
/// no edge.
const OWN: f32 = 0.1;
/// Path cost of a pixel where the carried plane would block another view.
const BLOCKING: f32 = 0.3;
/// RGB distance (Euclidean) up to which two views show the same point: gloss and exposure change
/// this much.
pub const COLOUR_TOLERANCE: f32 = 0.2;
/// Factor on a pixel's path cost where another view confirms the carried plane.
const CONFIRMED: f32 = 0.3;
/// Highest confidence of a filled pixel, below every matched one.
const FILLED_CONFIDENCE: f32 = 0.3;
/// Path cost at which a filled pixel's confidence has fallen to half.
const HALF_CONFIDENCE_COST: f32 = 0.5;

/// Rejects consistent pixels within `radius` of a depth step: there the matching window mixes two
/// surfaces, and filling finds the colour edge more exactly.
pub fn open_rims(level: &Level, surface: &Surface, radius: usize) -> Surface {
    let mut out = surface.clone();
    for (view, r) in level.references.iter().enumerate() {
        let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
        let depth = super::surface::depth(level, view, surface);
        for y in 0..height {
            for x in 0..width {
                let z = depth.at(x, y);
                let step = neighbours(y * width + x, width, height).any(|n| {
                    z > 0.0 && depth.data[n] > 0.0 && (depth.data[n] - z).abs() > free_space(level, view) * z
                });
                if !step {
                    continue;
                }
                for py in y.saturating_sub(radius)..(y + radius + 1).min(height) {
                    for px in x.saturating_sub(radius)..(x + radius + 1).min(width) {
                        out.confidence[first + py * width + px] = 0.0;
                    }
                }
            }
        }
    }
    out
}

/// Gives every pixel that is not void a plane. `surface` holds the consistent pixels, its planes
/// smoothed.
pub fn fill(
    level: &Level,
    links: &RelativePoses,
    surface: &Surface,
    large: &[WorldPlane],
    void: &[bool],
) -> Surface {
    let views: Vec<(Vec<Vec3>, Vec<f32>)> = (0..level.cameras.len())
        .into_par_iter()
        .map(|view| ViewFill::new(level, links, surface, void, view).run(large))
        .collect();
    let mut out = Surface { planes: Vec::new(), confidence: Vec::new() };
    for (planes, confidence) in views {
        out.planes.extend(planes);
        out.confidence.extend(confidence);
    }
    out
}

struct ViewFill<'a> {
    level: &'a Level,
    links: &'a RelativePoses,
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
        links: &'a RelativePoses,
        surface: &'a Surface,
        void: &'a [bool],
        view: usize,
    ) -> Self {
        let r = &level.references[view];
        let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
        ViewFill { level, links, surface, void, view, width, height, first }
    }

    fn run(&self, large: &[WorldPlane]) -> (Vec<Vec3>, Vec<f32>) {
        let pixels = self.width * self.height;
        let own = self.first..self.first + pixels;
        let mut planes = self.surface.planes[own.clone()].to_vec();
        let mut confidence = self.surface.confidence[own.clone()].to_vec();
        let mut best = vec![f32::INFINITY; pixels];
        let mut consider = |carried: &[u32], cost: &[f32], reluctance: f32, plane: &dyn Fn(usize) -> Vec3| {
            for k in 0..pixels {
                let cost = cost[k] * reluctance;
                if self.surface.confidence[self.first + k] <= 0.0 && cost < best[k] && carried[k] != u32::MAX
                {
                    best[k] = cost;
                    planes[k] = plane(carried[k] as usize);
                }
            }
        };
        let consistent: Vec<u32> =
            (0..pixels as u32).filter(|&k| self.surface.confidence[self.first + k as usize] > 0.0).collect();
        let (carried, cost) = self.spread(&consistent, None, None);
        consider(&carried, &cost, LOCAL_RELUCTANCE, &|source| self.surface.planes[self.first + source]);
        for plane in large {
            let Some(plane) = plane.in_camera(&self.level.cameras[self.view]) else { continue };
            let on: Vec<u32> =
                consistent.iter().copied().filter(|&k| self.lies_on(k as usize, plane)).collect();
            // A handful of pixels that touch the plane by chance must not carry it over the image.
            if on.len() * 1000 < pixels {
                continue;
            }
            let colours = ColourModel::new(&self.level.guide[self.view], &on, &consistent);
            let (carried, cost) = self.spread(&on, Some(plane), Some(&colours));
            consider(&carried, &cost, 1.0, &|_| plane);
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

    fn ray(&self, k: usize) -> Vec3 {
        ray(self.level, self.view, k % self.width, k / self.width)
    }

    fn lies_on(&self, k: usize, plane: Vec3) -> bool {
        let ray = self.ray(k);
        let here = self.surface.planes[self.first + k].dot(ray);
        (plane.dot(ray) - here).abs() < 0.5 * self.level.tolerance[self.view] * here
    }

    /// Dijkstra from the given pixels over the rejected pixels: per pixel where its plane comes
    /// from (`u32::MAX` = unreached) and the path cost. With `plane`, that plane is carried; else
    /// each source's own.
    fn spread(
        &self,
        sources: &[u32],
        plane: Option<Vec3>,
        colours: Option<&ColourModel>,
    ) -> (Vec<u32>, Vec<f32>) {
        let pixels = self.width * self.height;
        let mut cost = vec![f32::INFINITY; pixels];
        let mut carried = vec![u32::MAX; pixels];
        let mut heap = BinaryHeap::new();
        for &k in sources {
            cost[k as usize] = 0.0;
            carried[k as usize] = k;
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
                let candidate = plane.unwrap_or(self.surface.planes[self.first + carried[k] as usize]);
                let inverse = candidate.dot(self.ray(n));
                // Twice beyond the searched range: extrapolated to nonsense.
                if inverse < 0.5 * far || inverse > 2.0 * near {
                    continue;
                }
                let evidence = self.evidence(n, candidate);
                // Up to threefold the path cost for colours of other surfaces, next to nothing for
                // the plane's own.
                let foreign = colours.map_or(1.0, |c| FOREIGN * (1.0 - c.share(b)).powi(2) + OWN);
                let total = here + (STEP + difference) * evidence.0 * foreign + evidence.1;
                if total < cost[n] {
                    cost[n] = total;
                    carried[n] = carried[k];
                    heap.push((Reverse(total.to_bits()), n as u32));
                }
            }
        }
        (carried, cost)
    }

    /// Factor and addend on the path cost from what the other views see.
    fn evidence(&self, k: usize, plane: Vec3) -> (f32, f32) {
        let (x, y) = (k % self.width, k / self.width);
        let ray = self.ray(k);
        let point = ray / plane.dot(ray);
        let mut evidence = (1.0, 0.0);
        for other in (0..self.level.cameras.len()).filter(|&o| o != self.view) {
            let pixel = [x as f32 + 0.5, y as f32 + 0.5];
            match self.links.visibility(self.level, self.surface, self.view, other, pixel, point) {
                Visibility::FreeSpace => evidence.1 = BLOCKING,
                Visibility::Agrees => {
                    if self.same_colour(x, y, other, point) {
                        evidence.0 = CONFIRMED;
                    } else {
                        evidence.1 = BLOCKING;
                    }
                }
                _ => {}
            }
        }
        evidence
    }

    /// Whether the other view shows the point in a similar colour.
    fn same_colour(&self, x: usize, y: usize, other: usize, point: Vec3) -> bool {
        let Some((u, v, _)) = self.links.project(self.level, self.view, other, point) else { return true };
        let here = self.level.guide[self.view].at(x, y);
        let there = self.level.guide[other].at(u as usize, v as usize);
        (0..3).map(|c| (here[c] - there[c]).powi(2)).sum::<f32>().sqrt() < COLOUR_TOLERANCE
    }
}
