//! Planes for areas of weak texture, such as cupboard doors, from matched pixels at their rim.
//!
//! A photo is segmented into areas of even colour. For a largely unmatched area, the matched pixels
//! in and around it support planes by consensus. A plane with enough inliers that lies in no other
//! view's free space becomes the depth of the unmatched pixels. Two such planes meet at their
//! intersection if their inliers lie accordingly.
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
use votes::{Affine, CELL, CellSet, REACH, Spread, cells, evaluate, extent, plane_at};

/// Confidence of an inferred pixel: it shapes the surface but is no measurement.
pub const INFERRED: f32 = 0.35;
/// Merging threshold of the segmentation, RGB distance times pixels at a width of 640.
const MERGE_THRESHOLD: f32 = 2.0;
/// Smallest area, share of the image.
const SMALLEST: f32 = 0.02;
/// Smallest segment, share of the image; smaller ones (highlights, printing, noise) are merged.
const SPECK: f32 = 5e-4;
/// Least share of weak texture in an area …
const WEAK_SHARE: f32 = 0.5;
/// … and largest share of matched pixels: more are enough by themselves.
const MATCHED_SHARE: f32 = 0.6;
/// Width of the ring around an area whose pixels may belong to its rim, share of the view's width:
/// half the matching window and the trimmed depth edge.
const RING_SHARE: f32 = 1.0 / 60.0;
/// Distance up to which a cell is an inlier of a plane, multiples of the view's tolerance.
const WIDTH: f32 = 1.5;
/// A matched pixel is a mirror image if it lies behind its area's plane by this multiple of the
/// inlier distance …
const MIRRORED: f32 = 2.0;
/// … and such pixels are fewer than this share of the inliers' pixels: else the plane is doubtful.
const MIRROR_SHARE: f32 = 0.3;
/// Rounds of inference and check: inferred pixels of other views refute further planes.
const ROUNDS: usize = 3;
/// Largest share of an area's unmatched pixels that a plane may put into another view's free space.
const SEEN_THROUGH: f32 = 0.15;
/// Approximate number of pixels of an area tested for that.
const TESTED: usize = 200;

/// Infers planes of unmatched pixels in areas of weak texture. `surface` holds the matched pixels,
/// smoothed. Mirror images in shiny areas are dropped first: they would contradict other views'
/// planes.
pub fn fill(
    level: &Level,
    poses: &RelativePoses,
    surface: &Surface,
    void: &[bool],
    segments: &[Segmentation],
    seed: u32,
) -> Surface {
    let views: Vec<View> = segments.iter().enumerate().map(|(v, s)| View::new(level, v, s)).collect();
    let mut out = surface.clone();
    for k in views.par_iter().flat_map(|v| v.mirror_pixels(surface, seed)).collect::<Vec<_>>() {
        out.confidence[k] = 0.0;
    }
    let matched = out.clone();
    let areas: Vec<Vec<(&Area, CellSet)>> = views.par_iter().map(|v| v.unmatched_areas(&matched)).collect();
    for _ in 0..ROUNDS {
        let filled = views.par_iter().zip(&areas).flat_map(|(v, a)| v.inferred(poses, a, &out, void, seed));
        for (k, plane) in filled.collect::<Vec<_>>() {
            out.planes[k] = plane;
            out.confidence[k] = INFERRED;
        }
        out.confidence = without_contradicted(level, poses, &out);
    }
    transferred(level, poses, &out, &views, &areas, void)
}

/// Assigns to unmatched pixels of weak texture the plane on which most views agree, with their own
/// included: other views correct a plane that one view extends too far.
fn transferred(
    level: &Level,
    poses: &RelativePoses,
    surface: &Surface,
    views: &[View],
    areas: &[Vec<(&Area, CellSet)>],
    void: &[bool],
) -> Surface {
    let of_view = |(view, areas): (&View, &Vec<(&Area, CellSet)>)| -> Vec<(usize, Vec3)> {
        let is_open = |k: &usize| {
            [0.0, INFERRED].contains(&surface.confidence[view.first + k]) && !void[view.first + k]
        };
        let open = OpenPixels::new(
            areas.iter().flat_map(|(area, _)| &area.pixels).copied().filter(is_open),
            view.width * view.height,
        );
        let others: Vec<usize> = (0..views.len()).filter(|other| *other != view.view).collect();
        let seen: Vec<Vec<Option<Vec3>>> =
            others.par_iter().map(|other| view.planes_from(poses, surface, *other, &open)).collect();
        let at = |(place, &k): (usize, &usize)| {
            let of_others = others.iter().zip(&seen).filter_map(|(other, seen)| Some((*other, seen[place]?)));
            let mut planes: Vec<(usize, Vec3)> = of_others.collect();
            if planes.is_empty() {
                return None;
            }
            let index = view.first + k;
            let own = (surface.confidence[index] == INFERRED).then_some(surface.planes[index]);
            let place = planes.partition_point(|(other, _)| *other < view.view);
            own.iter().for_each(|plane| planes.insert(place, (view.view, *plane)));
            let plane = view.most_agreed(k, &planes, own)?;
            let ray = ray(level, view.view, k % view.width, k / view.width);
            let inverse = plane.dot(ray);
            let sound = inverse > 0.0 && !view.point_in_free_space(poses, surface, k, ray / inverse);
            sound.then_some((view.first + k, plane))
        };
        open.pixels.par_iter().enumerate().with_min_len(1024).filter_map(at).collect()
    };
    // One view after the other: each holds planes of all other views.
    let found: Vec<(usize, Vec3)> = views.iter().zip(areas).flat_map(of_view).collect();
    let mut out = surface.clone();
    for (k, plane) in found {
        out.planes[k] = plane;
        out.confidence[k] = INFERRED;
    }
    out
}

/// Confidence, 0 for inferred planes that contradict more of the other views than agree.
fn without_contradicted(level: &Level, poses: &RelativePoses, surface: &Surface) -> Vec<f32> {
    map_pixels(level, |view, x, y, k| {
        let confidence = surface.confidence[k];
        if confidence != INFERRED {
            return confidence;
        }
        let ray = ray(level, view, x, y);
        let (point, pixel) = (ray / surface.planes[k].dot(ray), [x as f32 + 0.5, y as f32 + 0.5]);
        let votes = level.neighbours(view).map(|other| {
            match poses.visibility(level, surface, view, other, pixel, point) {
                Visibility::Agrees => 1,
                Visibility::FreeSpace => -1,
                _ => 0,
            }
        });
        if votes.sum::<i32>() < 0 { 0.0 } else { confidence }
    })
}

/// Areas of even colour of all views; they depend on the photos alone.
pub fn segment(level: &Level, weak: &[bool]) -> Vec<Segmentation> {
    (0..level.references.len()).into_par_iter().map(|view| Segmentation::new(level, view, weak)).collect()
}

/// Areas of one view.
pub struct Segmentation {
    /// Area of every pixel, as [`Area::label`].
    labels: Vec<i32>,
    /// Areas that are large enough and of weak texture.
    areas: Vec<Area>,
}

/// An area of even colour.
struct Area {
    label: i32,
    pixels: Vec<usize>,
    /// The pixels, then those of the ring around them.
    around: Vec<usize>,
}

impl Segmentation {
    fn new(level: &Level, view: usize, weak: &[bool]) -> Segmentation {
        let r = &level.references[view];
        let (labels, count) = colour_segments(&level.guide[view]);
        let mut areas: Vec<(i32, Vec<usize>)> = (0..count as i32).map(|label| (label, Vec::new())).collect();
        for (k, &label) in labels.iter().enumerate() {
            areas[label as usize].1.push(k);
        }
        let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
        areas.retain(|(_, area)| {
            let weak_pixels = area.iter().filter(|&&k| weak[first + k]).count();
            area.len() as f32 >= SMALLEST * labels.len() as f32
                && weak_pixels as f32 > WEAK_SHARE * area.len() as f32
        });
        let ring = ((RING_SHARE * width as f32) as usize).max(CELL);
        let with_ring = |(label, pixels): (i32, Vec<usize>)| {
            let around = dilated(&pixels, ring, width, height);
            Area { label, pixels, around }
        };
        Segmentation { labels, areas: areas.into_par_iter().map(with_ring).collect() }
    }
}

/// Pixels of a view that take planes of other views.
struct OpenPixels {
    /// Ascending.
    pixels: Vec<usize>,
    /// Place of every pixel of the view in `pixels`, or `u32::MAX`.
    places: Vec<u32>,
}

impl OpenPixels {
    fn new(pixels: impl Iterator<Item = usize>, of: usize) -> OpenPixels {
        let mut pixels: Vec<usize> = pixels.collect();
        pixels.sort_unstable();
        pixels.dedup();
        let mut places = vec![u32::MAX; of];
        for (place, &k) in pixels.iter().enumerate() {
            places[k] = place as u32;
        }
        OpenPixels { pixels, places }
    }

    fn place(&self, k: usize) -> Option<usize> {
        Some(self.places[k]).filter(|p| *p != u32::MAX).map(|p| p as usize)
    }
}

/// One view with its segmentation.
struct View<'a> {
    level: &'a Level,
    view: usize,
    width: usize,
    height: usize,
    first: usize,
    segments: &'a Segmentation,
}

impl<'a> View<'a> {
    fn new(level: &'a Level, view: usize, segments: &'a Segmentation) -> View<'a> {
        let r = &level.references[view];
        let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
        View { level, view, width, height, first, segments }
    }

    /// Areas that are largely unmatched in `surface`, with cells of the matched pixels.
    fn unmatched_areas(&self, surface: &Surface) -> Vec<(&'a Area, CellSet)> {
        let depth = super::surface::depth(self.level, self.view, surface);
        let segments = self.segments;
        let unmatched = |area: &'a Area| {
            let Area { label, pixels, around } = area;
            let known = pixels.iter().filter(|&&k| depth.data[k] > 0.0).count();
            if known as f32 > MATCHED_SHARE * pixels.len() as f32 {
                return None;
            }
            let inner = |k: usize| segments.labels[k] == *label;
            let cells = cells(around, &depth.data, &inner, self.width);
            let tolerance = WIDTH * self.level.tolerance[self.view];
            Some((area, CellSet { cells, tolerance, extent: extent(pixels, self.width) }))
        };
        segments.areas.par_iter().filter_map(unmatched).collect()
    }

    /// The nearest inferred plane of another view at each of the view's `open` pixels, in their
    /// order, that shows its colour.
    fn planes_from(
        &self,
        poses: &RelativePoses,
        surface: &Surface,
        other: usize,
        open: &OpenPixels,
    ) -> Vec<Option<Vec3>> {
        let (level, r) = (self.level, &self.level.references[other]);
        let mut seen: Vec<Option<Vec3>> = vec![None; open.pixels.len()];
        for p in 0..(r.width * r.height) as usize {
            let index = r.first as usize + p;
            if surface.confidence[index] != INFERRED {
                continue;
            }
            let ray_there = ray(level, other, p % r.width as usize, p / r.width as usize);
            let point = ray_there / surface.planes[index].dot(ray_there);
            let Some((u, v, _)) = poses.project(level, other, self.view, point) else { continue };
            let k = v as usize * self.width + u as usize;
            let (here, there) = (level.guide[self.view].data[k], level.guide[other].data[p]);
            let colour_distance = (0..3).map(|c| (here[c] - there[c]).powi(2)).sum::<f32>().sqrt();
            if let Some(place) = open.place(k).filter(|_| colour_distance < COLOUR_TOLERANCE) {
                let plane = poses.plane(other, self.view, surface.planes[index]);
                let ray = ray(level, self.view, k % self.width, k / self.width);
                let nearest = seen[place].get_or_insert(plane);
                if plane.dot(ray) > nearest.dot(ray) {
                    *nearest = plane;
                }
            }
        }
        seen
    }

    /// The plane with which most of `planes`, by view, agree at a pixel, of several the nearest;
    /// `None` where no more agree with it than with the pixel's `own`.
    fn most_agreed(&self, k: usize, planes: &[(usize, Vec3)], own: Option<Vec3>) -> Option<Vec3> {
        let ray = ray(self.level, self.view, k % self.width, k / self.width);
        let inverse = |p: &Vec3| p.dot(ray);
        let tolerance = WIDTH * self.level.tolerance[self.view];
        let is_close = |a: &Vec3, b: &Vec3| (inverse(a) - inverse(b)).abs() < tolerance * inverse(a);
        let all = || planes.iter().map(|(_, plane)| plane);
        let agreement = |a: &Vec3| all().filter(|b| is_close(a, b)).count();
        let best =
            all().max_by(|a, b| agreement(a).cmp(&agreement(b)).then(inverse(a).total_cmp(&inverse(b))))?;
        own.is_none_or(|own| agreement(best) > agreement(&own)).then_some(*best)
    }

    /// Matched pixels of an area that lie behind its plane: mirror images.
    fn mirror_pixels(&self, surface: &Surface, seed: u32) -> Vec<usize> {
        let depth = super::surface::depth(self.level, self.view, surface);
        let of_area = |(area, cells): (&Area, CellSet)| -> Vec<usize> {
            let (planes, _) = cells.planes(hash(seed ^ area.label as u32), &|_, _| false);
            let is_behind = |k: &usize| {
                let (x, y) = ((k % self.width) as f32, (k / self.width) as f32);
                depth.data[*k] > 0.0
                    && plane_at(&planes, &[], x, y).is_some_and(|p| {
                        evaluate(p, x, y) * depth.data[*k] > 1.0 + MIRRORED * cells.tolerance
                    })
            };
            let behind: Vec<usize> = area.pixels.par_iter().copied().filter(is_behind).collect();
            let inliers: usize = planes.iter().map(|p| p.inliers.len()).sum();
            match (behind.len() as f32) < MIRROR_SHARE * (inliers * CELL * CELL) as f32 {
                true => behind.into_iter().map(|k| self.first + k).collect(),
                false => Vec::new(),
            }
        };
        self.unmatched_areas(surface).into_par_iter().flat_map(of_area).collect()
    }

    /// Pixels of `areas` without depth in `surface`, with planes of their cells that lie outside
    /// its free space.
    fn inferred(
        &self,
        poses: &RelativePoses,
        areas: &[(&Area, CellSet)],
        surface: &Surface,
        void: &[bool],
        seed: u32,
    ) -> Vec<(usize, Vec3)> {
        let r = &self.level.references[self.view];
        let [far, near] = r.range;
        let in_free_space = |k: usize, plane: Affine| self.plane_in_free_space(poses, surface, k, plane);
        let of_area = |(area, cells): &(&Area, CellSet)| -> Vec<(usize, Vec3)> {
            let is_open = |k: &usize| surface.confidence[self.first + k] <= 0.0 && !void[self.first + k];
            let open: Vec<usize> = area.pixels.iter().copied().filter(is_open).collect();
            if open.is_empty() {
                return Vec::new();
            }
            let pixel = |k: usize| ((k % self.width) as f32, (k / self.width) as f32);
            let violates_free_space = |plane: Affine, spread: &Spread| {
                let stride = (open.len() / TESTED).max(1);
                let reached = |k: &&usize| spread.distance(pixel(**k).0, pixel(**k).1) < REACH;
                let tested: Vec<&usize> = open.iter().step_by(stride).filter(reached).collect();
                let through = tested.iter().filter(|k| in_free_space(***k, plane)).count();
                through as f32 > SEEN_THROUGH * tested.len() as f32
            };
            let (planes, outliers) = cells.planes(hash(seed ^ area.label as u32), &violates_free_space);
            let at = |&k: &usize| {
                let (x, y) = pixel(k);
                let plane = plane_at(&planes, &outliers, x, y)?;
                // More than a factor of two beyond the searched range: a useless extrapolation.
                let sound =
                    (0.5 * far..2.0 * near).contains(&evaluate(plane, x, y)) && !in_free_space(k, plane);
                sound.then(|| (self.first + k, camera_plane(plane, r.intrinsics)))
            };
            open.par_iter().filter_map(at).collect()
        };
        areas.par_iter().flat_map(of_area).collect()
    }

    /// True if at a pixel the plane lies behind the camera or in another view's free space.
    fn plane_in_free_space(&self, poses: &RelativePoses, surface: &Surface, k: usize, plane: Affine) -> bool {
        let (x, y) = (k % self.width, k / self.width);
        let inverse = evaluate(plane, x as f32, y as f32);
        inverse <= 0.0
            || self.point_in_free_space(poses, surface, k, ray(self.level, self.view, x, y) / inverse)
    }

    /// True if a point of the camera's frame at pixel `k` lies in another view's free space.
    fn point_in_free_space(&self, poses: &RelativePoses, surface: &Surface, k: usize, point: Vec3) -> bool {
        let pixel = [(k % self.width) as f32 + 0.5, (k / self.width) as f32 + 0.5];
        self.level.neighbours(self.view).any(|other| {
            let seen = poses.visibility(self.level, surface, self.view, other, pixel, point);
            seen == Visibility::FreeSpace
        })
    }
}

/// Segmentation by colour: label of every pixel, and number of labels.
fn colour_segments(guide: &RgbImage) -> (Vec<i32>, usize) {
    let (width, height) = (guide.width, guide.height);
    let mut smooth = guide.data.clone();
    // Two passes of 1 2 1 along rows and columns against JPEG and sensor noise.
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
    let colour_distance =
        |p: usize, q: usize| (0..3).map(|c| (smooth[p][c] - smooth[q][c]).powi(2)).sum::<f32>().sqrt();
    let smallest = (SPECK * smooth.len() as f32) as u32;
    let (labels, count) =
        superpixels(width, height, MERGE_THRESHOLD * width as f32 / 640.0, smallest, colour_distance);
    (labels.data, count)
}

/// Pixels of an area and those up to `radius` steps away.
fn dilated(area: &[usize], radius: usize, width: usize, height: usize) -> Vec<usize> {
    let mut seen = vec![false; width * height];
    area.iter().for_each(|k| seen[*k] = true);
    let mut all = area.to_vec();
    let mut from = 0;
    for _ in 0..radius {
        let until = all.len();
        for k in from..until {
            for n in neighbours(all[k], width, height) {
                if !std::mem::replace(&mut seen[n], true) {
                    all.push(n);
                }
            }
        }
        from = until;
    }
    all
}

/// `π` of an affine inverse depth, which has pixel centres at integers.
fn camera_plane(plane: Affine, [fx, fy, cx, cy]: [f32; 4]) -> Vec3 {
    Vec3::new(plane[1] * fx, plane[2] * fy, evaluate(plane, cx - 0.5, cy - 0.5))
}
