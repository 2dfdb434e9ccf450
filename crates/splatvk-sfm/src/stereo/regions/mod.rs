//! Planes for areas of one colour: what matching cannot see in the middle of a cupboard door, its
//! rim and seams tell.
//!
//! A photo is cut into areas of even colour. Of an area that is largely unmatched, the matched
//! pixels in it and around it vote for planes; one that enough of its outline agrees with, and that
//! no other view sees through, becomes the depth of its unmatched pixels. Two such planes meet
//! where they intersect, if that is how their votes lie.
#[cfg(test)]
mod tests;
mod votes;

use super::Level;
use super::fill::COLOUR_TOLERANCE;
use super::surface::{RelativePoses, Surface, Visibility, map_pixels, neighbours, ray};
use crate::math::hash;
use crate::photo::superpixels;
use crate::scene::RgbImage;
use glam::Vec3;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashSet};
use votes::{Affine, CELL, REACH, Spread, Votes, at, cells, chosen, extent};

/// Confidence of such a pixel: it shapes the surface and is no measurement.
pub const INFERRED: f32 = 0.35;
/// Merging threshold of the areas, RGB distance times pixels at a width of 640.
const EVENNESS: f32 = 2.0;
/// Smallest area, share of the image.
const SMALLEST: f32 = 0.02;
/// Smaller ones join a neighbour: highlights, printing, noise.
const SPECK: f32 = 5e-4;
/// At least so much of an area must have weak texture …
const WEAK_SHARE: f32 = 0.5;
/// … and at most so much of it be matched: else what is matched tells enough.
const MATCHED_SHARE: f32 = 0.6;
/// Pixels around an area whose depth may be that of its rim, share of the width: the matching
/// window's half and the opened rim.
const RING_SHARE: f32 = 1.0 / 60.0;
/// Distance from a plane at which a cell still votes for it, multiples of the view's tolerance.
const WIDTH: f32 = 1.5;
/// A matched pixel is a mirror image if it lies behind its area's plane by so many widths of a vote
/// …
const MIRRORED: f32 = 2.0;
/// … and such pixels are fewer than this share of the voters' pixels: else the area is not what its
/// outline says.
const MIRROR_SHARE: f32 = 0.3;
/// Fills and refutations: what the other views have filled refutes a plane that nothing matched
/// could.
const ROUNDS: usize = 3;
/// Share of an area's unmatched pixels that a plane may put where another view sees through.
const SEEN_THROUGH: f32 = 0.15;
/// Pixels of an area that are tested for it, about.
const TESTED: usize = 200;

/// Gives unmatched pixels of weakly textured areas planes. `surface` holds the matched pixels,
/// smoothed; of those, mirror images in shiny areas are dropped first, since they would contradict
/// the planes of other views.
pub fn fill(
    level: &Level,
    links: &RelativePoses,
    surface: &Surface,
    void: &[bool],
    weak: &[bool],
    seed: u32,
) -> Surface {
    let views: Vec<View> = (0..level.cameras.len()).map(|v| View::new(level, v, weak)).collect();
    let mut out = surface.clone();
    for k in views.par_iter().flat_map_iter(|v| v.mirrored(surface, seed)).collect::<Vec<_>>() {
        out.confidence[k] = 0.0;
    }
    let matched = out.clone();
    for _ in 0..ROUNDS {
        let filled = views.par_iter().flat_map_iter(|v| v.filled(links, &matched, &out, void, seed));
        for (k, plane) in filled.collect::<Vec<_>>() {
            out.planes[k] = plane;
            out.confidence[k] = INFERRED;
        }
        out.confidence = unrefuted(level, links, &out);
    }
    transferred(level, links, &matched, &out, &views, void)
}

/// Gives weakly textured pixels that were not matched the plane that most views agree on, their own
/// one included: what one view extends too far, the others show.
fn transferred(
    level: &Level,
    links: &RelativePoses,
    matched: &Surface,
    surface: &Surface,
    views: &[View],
    void: &[bool],
) -> Surface {
    let mut out = surface.clone();
    for view in views {
        let weak: HashSet<i32> = view.weak(matched).map(|((label, _), _)| *label).collect();
        let open = |k: usize| {
            [0.0, INFERRED].contains(&surface.confidence[view.first + k])
                && !void[view.first + k]
                && weak.contains(&view.labels[k])
        };
        // What each other view would show at a pixel: the nearest of its points there.
        let mut seen: BTreeMap<usize, BTreeMap<usize, Vec3>> = BTreeMap::new();
        for (other, r) in level.references.iter().enumerate().filter(|(o, _)| *o != view.view) {
            for p in 0..(r.width * r.height) as usize {
                let index = r.first as usize + p;
                if surface.confidence[index] != INFERRED {
                    continue;
                }
                let ray_there = ray(level, other, p % r.width as usize, p / r.width as usize);
                let point = ray_there / surface.planes[index].dot(ray_there);
                let Some((u, v, _)) = links.project(level, other, view.view, point) else { continue };
                let k = v as usize * view.width + u as usize;
                let (here, there) = (level.guide[view.view].data[k], level.guide[other].data[p]);
                let apart = (0..3).map(|c| (here[c] - there[c]).powi(2)).sum::<f32>().sqrt();
                if open(k) && apart < COLOUR_TOLERANCE {
                    let plane = links.plane(other, view.view, surface.planes[index]);
                    let nearest = seen.entry(k).or_default().entry(other).or_insert(plane);
                    let ray = ray(level, view.view, k % view.width, k / view.width);
                    if plane.dot(ray) > nearest.dot(ray) {
                        *nearest = plane;
                    }
                }
            }
        }
        for (k, mut planes) in seen {
            let filled = surface.confidence[view.first + k] == INFERRED;
            if filled {
                planes.insert(view.view, surface.planes[view.first + k]);
            }
            let ray = ray(level, view.view, k % view.width, k / view.width);
            let inverse = |p: &Vec3| p.dot(ray);
            let near = |a: &Vec3, b: &Vec3| {
                (inverse(a) - inverse(b)).abs() < WIDTH * level.tolerance[view.view] * inverse(a)
            };
            let agree = |a: &Vec3| planes.values().filter(|b| near(a, b)).count();
            let best = planes
                .values()
                .max_by(|a, b| agree(a).cmp(&agree(b)).then(inverse(a).total_cmp(&inverse(b))));
            let best = best.filter(|p| !filled || agree(p) > agree(&surface.planes[view.first + k]));
            if let Some(plane) =
                best.filter(|p| inverse(p) > 0.0 && !view.hides(links, surface, k, ray / inverse(p)))
            {
                out.planes[view.first + k] = *plane;
                out.confidence[view.first + k] = INFERRED;
            }
        }
    }
    out
}

/// Confidence without the planes that more of the other views see through than see.
fn unrefuted(level: &Level, links: &RelativePoses, surface: &Surface) -> Vec<f32> {
    map_pixels(level, |view, x, y, k| {
        let confidence = surface.confidence[k];
        if confidence != INFERRED {
            return confidence;
        }
        let ray = ray(level, view, x, y);
        let (point, pixel) = (ray / surface.planes[k].dot(ray), [x as f32 + 0.5, y as f32 + 0.5]);
        let votes = (0..level.cameras.len()).filter(|&o| o != view).map(|other| {
            match links.visibility(level, surface, view, other, pixel, point) {
                Visibility::Agrees => 1,
                Visibility::FreeSpace => -1,
                _ => 0,
            }
        });
        if votes.sum::<i32>() < 0 { 0.0 } else { confidence }
    })
}

/// One view, cut into areas.
struct View<'a> {
    level: &'a Level,
    view: usize,
    width: usize,
    height: usize,
    first: usize,
    labels: Vec<i32>,
    /// Pixels of the areas that are large enough and of weak texture, by label.
    areas: Vec<(i32, Vec<usize>)>,
}

impl<'a> View<'a> {
    fn new(level: &'a Level, view: usize, weak: &[bool]) -> View<'a> {
        let r = &level.references[view];
        let (labels, count) = areas(&level.guide[view]);
        let mut areas: Vec<(i32, Vec<usize>)> = (0..count as i32).map(|label| (label, Vec::new())).collect();
        for (k, &label) in labels.iter().enumerate() {
            areas[label as usize].1.push(k);
        }
        let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
        areas.retain(|(_, area)| {
            let plain = area.iter().filter(|&&k| weak[first + k]).count();
            area.len() as f32 >= SMALLEST * labels.len() as f32
                && plain as f32 > WEAK_SHARE * area.len() as f32
        });
        View { level, view, width, height, first, labels, areas }
    }

    /// Areas that are largely unmatched in `surface`, with the votes of what is matched.
    fn weak<'s>(&'s self, surface: &'s Surface) -> impl Iterator<Item = (&'s (i32, Vec<usize>), Votes)> + 's {
        let depth = super::surface::depth(self.level, self.view, surface);
        let ring = ((RING_SHARE * self.width as f32) as usize).max(CELL);
        self.areas.iter().filter_map(move |area| {
            let (label, pixels) = area;
            let known = pixels.iter().filter(|&&k| depth.data[k] > 0.0).count();
            if known as f32 > MATCHED_SHARE * pixels.len() as f32 {
                return None;
            }
            let around = within(pixels, ring, self.width, self.height);
            let inner = |k: usize| self.labels[k] == *label;
            let cells = cells(&around, &depth.data, &inner, self.width);
            let tolerance = WIDTH * self.level.tolerance[self.view];
            Some((area, Votes { cells, tolerance, extent: extent(pixels, self.width) }))
        })
    }

    /// Matched pixels that show a mirror image: in an area, and behind the plane that its outline
    /// elects.
    fn mirrored(&self, surface: &Surface, seed: u32) -> Vec<usize> {
        let depth = super::surface::depth(self.level, self.view, surface);
        let mut out = Vec::new();
        for ((label, area), votes) in self.weak(surface) {
            let (planes, _) = votes.planes(hash(seed ^ *label as u32), &|_, _| false);
            let behind: Vec<usize> = area
                .iter()
                .copied()
                .filter(|&k| depth.data[k] > 0.0)
                .filter(|&k| {
                    let (x, y) = ((k % self.width) as f32, (k / self.width) as f32);
                    let plane = chosen(&planes, &[], x, y);
                    plane.is_some_and(|p| at(p, x, y) * depth.data[k] > 1.0 + MIRRORED * votes.tolerance)
                })
                .collect();
            let voters: usize = planes.iter().map(|p| p.voters.len()).sum();
            if (behind.len() as f32) < MIRROR_SHARE * (voters * CELL * CELL) as f32 {
                out.extend(behind.into_iter().map(|k| self.first + k));
            }
        }
        out
    }

    /// Pixels without depth in `surface`, with planes that `matched` elects and no view's `surface`
    /// refutes.
    fn filled(
        &self,
        links: &RelativePoses,
        matched: &Surface,
        surface: &Surface,
        void: &[bool],
        seed: u32,
    ) -> Vec<(usize, Vec3)> {
        let r = &self.level.references[self.view];
        let [far, near] = r.range;
        let blocks = |k: usize, plane: Affine| self.blocks(links, surface, k, plane);
        let mut out = Vec::new();
        for ((label, area), votes) in self.weak(matched) {
            let free = |k: &usize| surface.confidence[self.first + k] <= 0.0 && !void[self.first + k];
            let open: Vec<usize> = area.iter().copied().filter(free).collect();
            if open.is_empty() {
                continue;
            }
            let place = |k: usize| ((k % self.width) as f32, (k / self.width) as f32);
            let seen_through = |plane: Affine, spread: &Spread| {
                let stride = (open.len() / TESTED).max(1);
                let reached = |k: &&usize| spread.distance(place(**k).0, place(**k).1) < REACH;
                let tested: Vec<&usize> = open.iter().step_by(stride).filter(reached).collect();
                let through = tested.iter().filter(|k| blocks(***k, plane)).count();
                through as f32 > SEEN_THROUGH * tested.len() as f32
            };
            let (planes, against) = votes.planes(hash(seed ^ *label as u32), &seen_through);
            for &k in open.iter().filter(|_| !planes.is_empty()) {
                let (x, y) = place(k);
                let Some(plane) = chosen(&planes, &against, x, y) else { continue };
                // Twice beyond the searched range: extrapolated to nonsense.
                if (0.5 * far..2.0 * near).contains(&at(plane, x, y)) && !blocks(k, plane) {
                    out.push((self.first + k, camera_plane(plane, r.intrinsics)));
                }
            }
        }
        out
    }

    /// Whether the plane would hide, at a pixel, what another view has matched behind it.
    fn blocks(&self, links: &RelativePoses, surface: &Surface, k: usize, plane: Affine) -> bool {
        let (x, y) = (k % self.width, k / self.width);
        let inverse = at(plane, x as f32, y as f32);
        inverse <= 0.0 || self.hides(links, surface, k, ray(self.level, self.view, x, y) / inverse)
    }

    /// The same of a point in the camera's frame.
    fn hides(&self, links: &RelativePoses, surface: &Surface, k: usize, point: Vec3) -> bool {
        let pixel = [(k % self.width) as f32 + 0.5, (k / self.width) as f32 + 0.5];
        (0..self.level.cameras.len()).filter(|&o| o != self.view).any(|other| {
            let seen = links.visibility(self.level, surface, self.view, other, pixel, point);
            seen == Visibility::FreeSpace
        })
    }
}

/// Label of every pixel: areas of even colour.
fn areas(guide: &RgbImage) -> (Vec<i32>, usize) {
    let (width, height) = (guide.width, guide.height);
    let mut smooth = guide.data.clone();
    // Twice 1 2 1 along rows and columns: JPEG and sensor noise.
    for _ in 0..2 {
        for stride in [1, width] {
            let before = smooth.clone();
            for k in 0..smooth.len() {
                let inner = if stride == 1 { k % width } else { k / width };
                let last = if stride == 1 { width } else { height } - 1;
                let (a, b) =
                    (if inner > 0 { k - stride } else { k }, if inner < last { k + stride } else { k });
                smooth[k] = [0, 1, 2].map(|c| 0.25 * before[a][c] + 0.5 * before[k][c] + 0.25 * before[b][c]);
            }
        }
    }
    let apart =
        |p: usize, q: usize| (0..3).map(|c| (smooth[p][c] - smooth[q][c]).powi(2)).sum::<f32>().sqrt();
    let smallest = (SPECK * smooth.len() as f32) as u32;
    let (labels, count) = superpixels(width, height, EVENNESS * width as f32 / 640.0, smallest, apart);
    (labels.data, count)
}

/// The pixels of an area and those up to `radius` steps away.
fn within(area: &[usize], radius: usize, width: usize, height: usize) -> Vec<usize> {
    let mut seen: HashSet<usize> = area.iter().copied().collect();
    let mut all = area.to_vec();
    let mut from = 0;
    for _ in 0..radius {
        let until = all.len();
        for k in from..until {
            for n in neighbours(all[k], width, height) {
                if seen.insert(n) {
                    all.push(n);
                }
            }
        }
        from = until;
    }
    all
}

/// `π` of an affine inverse depth, whose pixels count from their centres.
fn camera_plane(plane: Affine, [fx, fy, cx, cy]: [f32; 4]) -> Vec3 {
    Vec3::new(plane[1] * fx, plane[2] * fy, at(plane, cx - 0.5, cy - 0.5))
}
