//! Faces that one photo alone shows, such as the side of a box that the other photos see from the
//! front.
//!
//! Filling gives such a face the plane of a neighbour, mostly of the surface behind it. Another
//! view then shows that place in a different colour. The pixels that other views refute in this way
//! form faces; a face gets the plane through pixels at its rim that no view refutes: in the other
//! views it lies behind the surface in front, or outside of the image.
use super::Level;
use super::fill::COLOUR_TOLERANCE;
use super::planes::WorldPlane;
use super::regions::INFERRED;
use super::surface::{RelativePoses, Surface, Visibility, neighbours, ray};
use crate::math::hash;
use glam::{Mat3, Vec3};
use rayon::prelude::*;

/// Smallest face, share of the image; smaller groups of refuted pixels are edges.
const SMALLEST: f32 = 4e-4;
/// Width of the rim, share of the view's width: the trimmed depth edge and half the matching
/// window.
const RIM_SHARE: f32 = 1.0 / 50.0;
/// Hypotheses per kind: through three pixels of the rim, and through two along an axis.
const TRIALS: u32 = 400;
/// Approximate number of pixels of a face, and of its rim, that a hypothesis is tested on.
const TESTED: usize = 150;
/// Largest share of the tested pixels that other views may refute.
const REFUTED_SHARE: f32 = 0.1;
/// Least share of the rim on the plane.
const RIM_INLIERS: f32 = 0.15;
/// RGB distance to a face's mean colour at which the weight of a pixel of its rim falls to 1/e …
const SAME_COLOUR: f32 = 0.15;
/// … and the least weight: the table below a thing has most of the rim, and seldom its colour.
const FOREIGN: f32 = 0.1;
/// Factor on the rim of a plane along an axis: most corners are right angles, and the rim often
/// leaves the tilt about its front edge open.
const RIGHT_ANGLE: f32 = 1.2;
/// The nearest plane counts of those with at least this share of the most pixels of the rim.
const NEAREST_OF: f32 = 0.4;
/// Most axes: the normals of large planes, along which boxes on them have their edges.
const AXES: usize = 3;

/// Replaces the filled planes of faces in `complete` and returns the surface from which to fill
/// again: `known` with the planes of the faces. `None` where there are no faces.
pub fn faces(
    level: &Level,
    poses: &RelativePoses,
    known: &Surface,
    complete: &Surface,
    large: &[WorldPlane],
    seed: u32,
) -> Option<Surface> {
    let views = (0..level.cameras.len()).into_par_iter();
    let found: Vec<(usize, Vec3)> = views
        .flat_map_iter(|view| View::new(level, poses, known, complete, view).faces(large, seed))
        .collect();
    if found.is_empty() {
        return None;
    }
    let mut out = known.clone();
    for (index, plane) in found {
        out.planes[index] = plane;
        out.confidence[index] = INFERRED;
    }
    Some(out)
}

/// Pixel beside a face.
struct RimPixel {
    ray: Vec3,
    inverse: f32,
    /// Share in the score of a plane.
    weight: f32,
}

struct View<'a> {
    level: &'a Level,
    poses: &'a RelativePoses,
    known: &'a Surface,
    complete: &'a Surface,
    view: usize,
    width: usize,
    height: usize,
    first: usize,
}

impl<'a> View<'a> {
    fn new(
        level: &'a Level,
        poses: &'a RelativePoses,
        known: &'a Surface,
        complete: &'a Surface,
        view: usize,
    ) -> Self {
        let r = &level.references[view];
        let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
        View { level, poses, known, complete, view, width, height, first }
    }

    /// Pixels of faces with their planes.
    fn faces(&self, large: &[WorldPlane], seed: u32) -> Vec<(usize, Vec3)> {
        let refuted: Vec<bool> = (0..self.width * self.height)
            .map(|k| {
                let index = self.first + k;
                let is_filled = self.known.confidence[index] <= 0.0 && self.complete.confidence[index] > 0.0;
                is_filled && self.refutes(k, self.complete.planes[index])
            })
            .collect();
        let pixels_of = |face: &Vec<usize>| -> Vec<(usize, Vec3)> {
            let seed = hash(seed ^ face[0] as u32);
            let Some(plane) = self.plane_of(face, &refuted, large, seed) else { return Vec::new() };
            let sound = face.iter().filter(|k| !self.refutes(**k, plane));
            sound.map(|k| (self.first + k, plane)).collect()
        };
        self.components(&refuted).par_iter().flat_map_iter(pixels_of).collect()
    }

    /// Connected groups of refuted pixels, without the small ones.
    fn components(&self, refuted: &[bool]) -> Vec<Vec<usize>> {
        let smallest = (SMALLEST * refuted.len() as f32) as usize;
        let mut done = vec![false; refuted.len()];
        let mut out = Vec::new();
        for start in (0..refuted.len()).filter(|k| refuted[*k]) {
            if done[start] {
                continue;
            }
            done[start] = true;
            let mut group = vec![start];
            let mut next = 0;
            while next < group.len() {
                for n in neighbours(group[next], self.width, self.height) {
                    if refuted[n] && !done[n] {
                        done[n] = true;
                        group.push(n);
                    }
                }
                next += 1;
            }
            if group.len() >= smallest.max(1) {
                out.push(group);
            }
        }
        out
    }

    fn ray(&self, k: usize) -> Vec3 {
        ray(self.level, self.view, k % self.width, k / self.width)
    }

    /// Whether another view refutes a plane at a pixel: it sees through the point, or shows it in
    /// another colour. A plane beyond the searched depth is refuted, too.
    fn refutes(&self, k: usize, plane: Vec3) -> bool {
        let ray = self.ray(k);
        let inverse = plane.dot(ray);
        let [far, near] = self.level.references[self.view].range;
        if inverse < 0.5 * far || inverse > 2.0 * near {
            return true;
        }
        let (x, y) = (k % self.width, k / self.width);
        let (pixel, point) = ([x as f32 + 0.5, y as f32 + 0.5], ray / inverse);
        let visibility =
            |surface, other| self.poses.visibility(self.level, surface, self.view, other, pixel, point);
        self.level.neighbours(self.view).any(|other| {
            // Filled depth of another view is no proof of free space, but mostly right: a wrong
            // plane seldom has its colour there by chance.
            visibility(self.known, other) == Visibility::FreeSpace
                || visibility(self.complete, other) == Visibility::Agrees
                    && !self.same_colour(k, other, point)
        })
    }

    fn same_colour(&self, k: usize, other: usize, point: Vec3) -> bool {
        let Some((u, v, _)) = self.poses.project(self.level, self.view, other, point) else { return true };
        let (here, there) =
            (self.level.guide[self.view].data[k], self.level.guide[other].at(u as usize, v as usize));
        (0..3).map(|c| (here[c] - there[c]).powi(2)).sum::<f32>().sqrt() < COLOUR_TOLERANCE
    }

    /// The nearest of the planes with many pixels of the rim on them that no view refutes.
    fn plane_of(&self, face: &[usize], refuted: &[bool], large: &[WorldPlane], seed: u32) -> Option<Vec3> {
        let rim = self.rim(face, refuted);
        if rim.len() < 12 {
            return None;
        }
        let tested = every(face, TESTED);
        let rotation = self.level.cameras[self.view].pose.rotation;
        let axes: Vec<Vec3> = large.iter().take(AXES).map(|p| (rotation * p.normal).as_vec3()).collect();
        let mut state = seed;
        let mut draw = || {
            state = hash(state);
            let pixel = &rim[state as usize % rim.len()];
            (pixel.ray, pixel.inverse)
        };
        let mut planes = Vec::new();
        for axis in &axes {
            for _ in 0..TRIALS {
                planes.extend(along_axis([draw(), draw()], *axis).map(|plane| (plane, RIGHT_ANGLE)));
            }
        }
        for _ in 0..TRIALS {
            planes.extend(through_points([draw(), draw(), draw()]).map(|plane| (plane, 1.0)));
        }
        let tolerance = self.level.tolerance[self.view];
        let on = |plane: Vec3, p: &RimPixel| (plane.dot(p.ray) - p.inverse).abs() < tolerance * p.inverse;
        let weight_on = |plane: Vec3| rim.iter().filter(|p| on(plane, p)).map(|p| p.weight).sum::<f32>();
        let most_refuted = (REFUTED_SHARE * tested.len() as f32) as usize;
        let is_sound = |plane: &Vec3| {
            let mut wrong = 0;
            tested.iter().all(|k| {
                wrong += usize::from(self.refutes(*k, *plane));
                wrong <= most_refuted
            })
        };
        let least = RIM_INLIERS * rim.iter().map(|p| p.weight).sum::<f32>();
        let mut scored: Vec<(f32, Vec3)> =
            planes.into_iter().map(|(plane, factor)| (factor * weight_on(plane), plane)).collect();
        scored.retain(|(score, _)| *score >= least);
        // The order of equal ones is that of the draws.
        scored.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut rest = scored.into_iter();
        let best = rest.by_ref().find(|(_, plane)| is_sound(plane))?;
        // A plane further back leaves a gap to the surface in front, and hides there, too.
        let enough = rest.take_while(|(score, _)| *score >= NEAREST_OF * best.0);
        let middle = self.ray(face[face.len() / 2]);
        let inverse = |plane: &Vec3| plane.dot(middle);
        let nearer = |a: Vec3, b: Vec3| if inverse(&b) > inverse(&a) { b } else { a };
        Some(enough.map(|(_, plane)| plane).filter(is_sound).fold(best.1, nearer))
    }

    /// Pixels around a face, of those that no view refutes. Those of the face's colour are likely
    /// of the same thing.
    fn rim(&self, face: &[usize], refuted: &[bool]) -> Vec<RimPixel> {
        let radius = ((RIM_SHARE * self.width as f32) as usize).max(4);
        let place = |k: usize| (k % self.width, k / self.width);
        let bounds = |axis: fn((usize, usize)) -> usize, count: usize| {
            let values = || face.iter().map(|k| axis(place(*k)));
            let (low, high) = (values().min().unwrap_or(0), values().max().unwrap_or(0));
            low.saturating_sub(radius)..(high + radius + 1).min(count)
        };
        let (columns, rows) = (bounds(|p| p.0, self.width), bounds(|p| p.1, self.height));
        let mut near = vec![false; columns.len() * rows.len()];
        // Windows around the outline cover those around the inner pixels, but for the face itself.
        let is_outline = |k: &&usize| neighbours(**k, self.width, self.height).any(|n| !refuted[n]);
        for k in face.iter().filter(is_outline) {
            let (x, y) = place(*k);
            for row in y.saturating_sub(radius)..(y + radius + 1).min(rows.end) {
                let line = (row - rows.start) * columns.len();
                let (from, to) =
                    (x.saturating_sub(radius).max(columns.start), (x + radius + 1).min(columns.end));
                near[line + from - columns.start..line + to - columns.start].fill(true);
            }
        }
        let index =
            |i: usize| (rows.start + i / columns.len()) * self.width + columns.start + i % columns.len();
        let known = |k: &usize| !refuted[*k] && self.complete.confidence[self.first + k] > 0.0;
        let pixels: Vec<usize> = (0..near.len()).filter(|i| near[*i]).map(index).filter(known).collect();
        let colour = |k: usize| Vec3::from(self.level.guide[self.view].data[k]);
        let mean = face.iter().map(|k| colour(*k)).sum::<Vec3>() / face.len() as f32;
        let pixel = |k: usize| {
            let ray = self.ray(k);
            let weight = FOREIGN + (-colour(k).distance(mean) / SAME_COLOUR).exp();
            RimPixel { ray, inverse: self.complete.planes[self.first + k].dot(ray), weight }
        };
        every(&pixels, 4 * TESTED).into_iter().map(pixel).filter(|p| p.inverse > 0.0).collect()
    }
}

/// About `count` of the values, evenly.
fn every(values: &[usize], count: usize) -> Vec<usize> {
    values.iter().copied().step_by((values.len() / count).max(1)).collect()
}

/// The plane through three points, given by ray and inverse depth.
fn through_points([a, b, c]: [(Vec3, f32); 3]) -> Option<Vec3> {
    let rows = Mat3::from_cols(a.0, b.0, c.0).transpose();
    // Nearly collinear rays leave the tilt open.
    if rows.determinant().abs() < 1e-5 {
        return None;
    }
    Some(rows.inverse() * Vec3::new(a.1, b.1, c.1))
}

/// The plane through two points that contains a direction.
fn along_axis([a, b]: [(Vec3, f32); 2], axis: Vec3) -> Option<Vec3> {
    let (p, q) = (a.0 / a.1, b.0 / b.1);
    let normal = (q - p).cross(axis).try_normalize()?;
    let offset = normal.dot(p);
    (offset.abs() > 1e-6 * p.length()).then(|| normal / offset)
}

#[cfg(test)]
mod tests {
    use super::super::surface::map_pixels;
    use super::super::tests::{HEIGHT, WIDTH, camera_at, pixel_centre};
    use super::super::{StereoOptions, fill, planes, pyramid};
    use super::*;
    use crate::scene::{Camera, RgbImage};
    use glam::{DVec2, DVec3};

    /// Front of a box, its left side, or the wall behind, at the end of a ray; with its colour.
    fn hit(camera: &Camera, pixel: DVec2) -> (DVec3, [f32; 3]) {
        let (centre, ray) = (camera.pose.centre(), camera.ray(pixel));
        let front = centre + 2.0 * ray;
        if front.x.abs() < 0.3 && front.y.abs() < 0.3 {
            return (front, [0.8, 0.3 + 0.2 * (9.0 * front.x).sin() as f32, 0.2]);
        }
        let side = centre + ray * ((-0.3 - centre.x) / ray.x);
        if ray.x > 0.0 && centre.x < -0.3 && (2.0..2.6).contains(&side.z) && side.y.abs() < 0.3 {
            return (side, [0.7, 0.2, 0.2]);
        }
        let wall = centre + 4.0 * ray;
        (wall, [0.2, 0.6, 0.5 + 0.2 * (5.0 * wall.x).sin() as f32])
    }

    /// True for points of the side.
    fn is_side(point: DVec3) -> bool {
        (2.001..2.61).contains(&point.z)
    }

    /// Three views, of which the first alone stands to the left of the box. They match the front and
    /// the wall where another view shows them, too.
    fn box_scene() -> ([Camera; 3], Level, Surface) {
        let cameras = [camera_at(-0.9), camera_at(0.0), camera_at(0.4)];
        let images = cameras.each_ref().map(|c| RgbImage {
            width: WIDTH,
            height: HEIGHT,
            data: (0..WIDTH * HEIGHT).map(|k| hit(c, pixel_centre(k)).1).collect(),
        });
        let sparse: Vec<DVec3> =
            (0..WIDTH * HEIGHT).step_by(97).map(|k| hit(&cameras[0], pixel_centre(k)).0).collect();
        let options = StereoOptions { rounds: vec![1], ..StereoOptions::default() };
        let level = pyramid(&images, &cameras, &sparse, &options).unwrap().pop().unwrap();
        let at = |view: usize, x: usize, y: usize| hit(&cameras[view], pixel_centre(y * WIDTH + x)).0;
        let planes = map_pixels(&level, |view, x, y, _| Vec3::Z / at(view, x, y).z as f32);
        let shown = |point: DVec3, other: usize| {
            let (p, z) = cameras[other].project(point);
            let inside = p.x >= 0.0 && p.y >= 0.0 && p.x < WIDTH as f64 && p.y < HEIGHT as f64;
            inside && z > 0.0 && (hit(&cameras[other], p).0 - point).length() < 0.02
        };
        let confidence = map_pixels(&level, |view, x, y, _| {
            let point = at(view, x, y);
            let twice = (0..3).any(|other| other != view && shown(point, other));
            if twice && !is_side(point) { 0.9 } else { 0.0 }
        });
        (cameras, level, Surface { planes, confidence })
    }

    #[test]
    fn side_of_box_gets_its_plane() {
        let (cameras, level, known) = box_scene();
        let poses = RelativePoses::new(&level);
        let void = vec![false; level.pixels()];
        let large = planes::large_planes(&level, &known, 1);
        let complete = fill::fill(&level, &poses, &known, &large, &void);
        let with_faces = faces(&level, &poses, &known, &complete, &large, 1).unwrap();
        let after = fill::fill(&level, &poses, &with_faces, &large, &void);
        let side: Vec<usize> =
            (0..WIDTH * HEIGHT).filter(|k| is_side(hit(&cameras[0], pixel_centre(*k)).0)).collect();
        let wrong = |surface: &Surface| {
            let error = |k: &usize| {
                let found = surface.planes[*k].dot(ray(&level, 0, k % WIDTH, k / WIDTH));
                (f64::from(found) * hit(&cameras[0], pixel_centre(*k)).0.z - 1.0).abs()
            };
            side.iter().filter(|k| error(k) > 0.03).count()
        };
        let (before, now) = (wrong(&complete), wrong(&after));
        println!("side {} pixels, wrong {before} -> {now}", side.len());
        assert!(before > side.len() / 2 && now * 20 < side.len(), "{before} -> {now} of {}", side.len());
        // Nothing else is a face.
        let others = with_faces.confidence[WIDTH * HEIGHT..].iter().filter(|c| **c == INFERRED).count();
        assert_eq!(others, 0);
    }

    #[test]
    fn refutes_surface_of_another_colour() {
        let (cameras, mut level, known) = box_scene();
        let poses = RelativePoses::new(&level);
        // Pixels whose wall another view shows, too.
        let wall: Vec<usize> = (0..WIDTH * HEIGHT)
            .filter(|k| known.confidence[*k] > 0.0 && hit(&cameras[0], pixel_centre(*k)).0.z > 3.9)
            .collect();
        let refuted = |level: &Level| {
            let view = View::new(level, &poses, &known, &known, 0);
            wall.iter().filter(|k| view.refutes(**k, Vec3::Z / 4.0)).count()
        };
        let green = refuted(&level);
        wall.iter().for_each(|k| level.guide[0].data[*k] = [0.7, 0.2, 0.2]);
        let red = refuted(&level);
        println!("of {}: {green} with their colour, {red} in red", wall.len());
        assert!(20 * green < wall.len() && 2 * red > wall.len());
    }

    #[test]
    fn rim_of_own_colour_weighs_more() {
        let (cameras, level, known) = box_scene();
        let poses = RelativePoses::new(&level);
        let view = View::new(&level, &poses, &known, &known, 0);
        let side: Vec<bool> =
            (0..WIDTH * HEIGHT).map(|k| is_side(hit(&cameras[0], pixel_centre(k)).0)).collect();
        let face: Vec<usize> = (0..side.len()).filter(|k| side[*k]).collect();
        let rim = view.rim(&face, &side);
        let mean = |inverse: f32| {
            let weights: Vec<f32> =
                rim.iter().filter(|p| (p.inverse - inverse).abs() < 0.01).map(|p| p.weight).collect();
            weights.iter().sum::<f32>() / weights.len() as f32
        };
        // The red front of the box at z = 2, the green wall at z = 4.
        let (front, wall) = (mean(1.0 / 2.0), mean(1.0 / 4.0));
        assert!(front > 3.0 * wall, "front {front}, wall {wall}");
    }
}
