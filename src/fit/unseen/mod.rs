//! Surfaces extrapolated beyond the photos.
//!
//! Between a few views, a camera soon sees regions without splats, beyond the borders of the photos
//! and behind objects. The inverse depth of a plane is affine in the pixel position, so floors,
//! tables and walls continue exactly: coarse flat splats extend the plane that ends at a photo
//! border or at a depth edge, in its mean colour. They are in no training view, so they do not
//! change the loss.
mod anchor;
mod backdrop;

use crate::math::Random;
use crate::scene::{Camera, DepthMap, RgbImage, SH_C0, Sky, Splats};
pub(super) use backdrop::backdrop;

use super::options::RgbOptions;
use super::photos::Photos;
use super::virtual_views::views_beside;
use anchor::{Anchor, BEHIND, STEP, Shown};
use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;
use std::collections::HashSet;

/// Reach of a plane behind a depth edge, in units of the longer image side. At a field of view of
/// 55°, a camera that orbits the front object by 20° uncovers 0.12 of a surface at 1.5 times its
/// depth.
const REVEALED: f64 = 0.12;
/// Standard deviation in units of the grid: splats of cells that touch at a corner blend without
/// gaps.
const OVERLAP: f64 = 1.0;
/// Opacity next to the end of a surface.
const OPACITY: f64 = 0.98;
/// Share of the reach from which the opacity falls, to [`LEAST_OPACITY`] at its end.
const FADES_FROM: f64 = 0.4;
const LEAST_OPACITY: f64 = 0.02;

/// Candidate splat.
struct UnseenSplat {
    /// Distance from the end of the surface, pixels.
    distance: f64,
    /// [`Self::distance`] over the reach.
    share: f64,
    position: DVec3,
    /// World steps of one grid cell along x and y.
    steps: [DVec3; 2],
    colour: [f32; 3],
}

/// Surfaces that continue those of photos; empty without depth, with a margin of 0, and with an
/// empty background, where surfaces end at the silhouette.
pub(super) fn continued_surfaces(photos: &Photos, options: &RgbOptions) -> Splats {
    let Photos { images, cameras, depths: Some(depths), .. } = *photos else { return Splats::default() };
    if options.margin <= 0.0 || photos.show_emptiness() {
        return Splats::default();
    }
    let (reach, confidence) = (options.margin, options.min_confidence);
    let beside = views_beside(photos, confidence, options.seed);
    unseen_splats(images, cameras, depths, &beside, reach, confidence, options.most_unseen, options.seed)
}

/// Creates flat splats around all photos and behind their depth edges, up to `reach` times the
/// longer side from the end of a surface. None stands before a surface that a photo shows, neither
/// from the photos nor from the views `beside` them. Depth below `min_confidence` is ignored. Of more
/// than `most`, those nearest to the ends of surfaces are kept.
fn unseen_splats(
    images: &[RgbImage],
    cameras: &[Camera],
    depths: &[DepthMap],
    beside: &[(Camera, DepthMap)],
    reach: f64,
    min_confidence: f32,
    most: usize,
    seed: u64,
) -> Splats {
    let sky = Sky::of(cameras, depths);
    let views = images.len().min(depths.len());
    let shown: Vec<Shown> = (0..views)
        .map(|v| Shown { image: &images[v], camera: &cameras[v], depth: &depths[v], min_confidence })
        .collect();
    let random = |view: usize| Random::new(seed ^ 0x3a61 ^ ((view as u64) << 32));
    let borders: Vec<Vec<Anchor>> =
        (0..views).into_par_iter().map(|v| anchor::at_border(&shown[v], &mut random(v))).collect();
    let splats_of_view = |view: usize| -> Vec<UnseenSplat> {
        let reach = reach * shown[view].long();
        let mut own = candidates(&shown[view], &borders[view], sky.as_ref(), reach, &mut random(view));
        let in_photo = |c: &UnseenSplat, v: usize| {
            depth_at(c, &cameras[v], &depths[v]).is_some_and(|(z, known)| known <= 0.0 || z < BEHIND * known)
        };
        let in_view = |c: &UnseenSplat, (camera, depth): &(Camera, DepthMap)| {
            depth_at(c, camera, depth).is_some_and(|(z, known)| known > 0.0 && z < known / BEHIND)
        };
        own.retain(|c| !(0..views).any(|v| v != view && in_photo(c, v)));
        own.retain(|c| !(0..views).any(|v| v != view && before_nearer_border(c, &shown[v], &borders[v])));
        own.retain(|c| !beside.iter().any(|v| in_view(c, v)));
        own
    };
    let mut all: Vec<UnseenSplat> = (0..views).into_par_iter().flat_map(splats_of_view).collect();
    // Where several photos continue one surface, the nearest end has priority.
    all.sort_by(|a, b| a.distance.total_cmp(&b.distance));
    let mut taken = HashSet::new();
    let mut splats = Splats::default();
    for c in &all {
        if splats.len() == most {
            break;
        }
        let size = c.steps[0].length().min(c.steps[1].length()).max(1e-12);
        let octave = size.log2().round();
        let cell = (c.position / (octave.exp2())).floor().as_i64vec3();
        if taken.insert((octave as i64, cell)) {
            push(&mut splats, c);
        }
    }
    splats
}

/// Candidates around one photo and behind its surfaces, up to `reach` pixels from the end of a
/// surface.
fn candidates(
    shown: &Shown,
    borders: &[Anchor],
    sky: Option<&Sky>,
    reach: f64,
    random: &mut Random,
) -> Vec<UnseenSplat> {
    let size = shown.size();
    // Hidden surfaces appear in narrow gaps, so their grid is twice as fine as beyond the borders.
    let (step, fine) = (STEP * shown.long(), 0.5 * STEP * shown.long());
    let revealed = REVEALED * shown.long();
    let mut edges = anchor::at_edges(shown, fine, random);
    // Sky continues beyond the borders. Behind surfaces it is left to the backdrop: splats of its
    // size would shine through every gap of the ground.
    edges.retain(|a| {
        let point = shown.camera.unproject(a.at, 1.0 / a.w);
        sky.is_none_or(|sky| !sky.contains(point))
    });
    let continued = |anchor: &Anchor, pixel: DVec2, step: f64, reach: f64| {
        candidate(shown.camera, anchor, pixel, reach, step)
    };
    let beyond = |pixel: DVec2| -> Option<[Option<UnseenSplat>; 2]> {
        let border = pixel.clamp(DVec2::ZERO, size);
        let outside = border != pixel && border.distance(pixel) < reach;
        let front = Anchor::typical(borders, border, pixel).filter(|_| outside)?;
        // The front surface may end there, so the next one behind it continues, too.
        let next = borders.iter().chain(&edges).filter(|a| a.inverse(pixel) * BEHIND < front.inverse(pixel));
        let next = Anchor::nearest(next, pixel).filter(|a| a.at.distance(pixel) < reach);
        Some([continued(front, pixel, step, reach), next.and_then(|a| continued(a, pixel, step, reach))])
    };
    let behind = |pixel: DVec2| -> Option<UnseenSplat> {
        let depth = shown.depth_at(pixel.x as usize, pixel.y as usize);
        // Only behind the visible surface: a continuation on it would shine through splats that
        // training leaves transparent.
        let next = Anchor::nearest(edges.iter(), pixel)
            .filter(|a| a.at.distance(pixel) < revealed)
            .filter(|a| depth.is_some_and(|z| a.inverse(pixel) * z * BEHIND < 1.0));
        next.and_then(|a| continued(a, pixel, fine, revealed))
    };
    let outer: Vec<DVec2> = shown.cells(step, reach).collect();
    let inner: Vec<DVec2> = shown.cells(fine, 0.0).filter(|p| p.x < size.x && p.y < size.y).collect();
    let outer = outer.into_par_iter().flat_map_iter(|pixel| beyond(pixel).into_iter().flatten().flatten());
    outer.chain(inner.into_par_iter().filter_map(behind)).collect()
}

/// Depth of a candidate in a view, and of the surface at its pixel, 0 where that is unknown; `None`
/// outside of the view.
fn depth_at(c: &UnseenSplat, camera: &Camera, map: &DepthMap) -> Option<(f64, f64)> {
    let (pixel, z) = camera.project(c.position);
    let (w, h) = (map.depth.width as f64, map.depth.height as f64);
    let inside = z > 0.0 && pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < w && pixel.y < h;
    inside.then(|| (z, f64::from(map.depth.at(pixel.x as usize, pixel.y as usize))))
}

/// Whether a candidate stands before the surface that another photo continues, and lies nearer to
/// the border of that photo than to the end of its own surface. The roof that one photo cuts off
/// does not rise above the ridge that another one shows.
fn before_nearer_border(c: &UnseenSplat, other: &Shown, borders: &[Anchor]) -> bool {
    let (pixel, z) = other.camera.project(c.position);
    let border = pixel.clamp(DVec2::ZERO, other.size());
    let nearer = z > 0.0 && border != pixel && border.distance(pixel) < c.distance;
    let surface = Anchor::typical(borders, border, pixel).filter(|_| nearer);
    surface.is_some_and(|a| a.inverse(pixel) * z * BEHIND < 1.0)
}

/// Candidate that continues the plane of an anchor at a pixel; `None` near or past the horizon.
fn candidate(camera: &Camera, anchor: &Anchor, pixel: DVec2, reach: f64, step: f64) -> Option<UnseenSplat> {
    // Planes beyond three times the depth of their end, or nearer than half of it, are unreliable.
    let value = anchor.inverse(pixel);
    if value < anchor.w / 3.0 || value > anchor.w * 2.0 {
        return None;
    }
    let world = |p: DVec2| camera.unproject(p, 1.0 / anchor.inverse(p).max(anchor.w / 4.0));
    let position = world(pixel);
    let steps = [DVec2::X, DVec2::Y].map(|e| world(pixel + 0.5 * step * e) - world(pixel - 0.5 * step * e));
    let distance = anchor.at.distance(pixel);
    Some(UnseenSplat { distance, share: distance / reach, position, steps, colour: anchor.colour })
}

/// Appends a flat splat that spans one grid cell of the plane.
fn push(splats: &mut Splats, c: &UnseenSplat) {
    let (long, short) = if c.steps[0].length() >= c.steps[1].length() {
        (c.steps[0], c.steps[1])
    } else {
        (c.steps[1], c.steps[0])
    };
    let x = long.normalize_or(DVec3::X);
    let normal = x.cross(short).normalize_or(x.any_orthonormal_vector());
    let y = normal.cross(x);
    let q = DQuat::from_mat3(&DMat3::from_cols(x, y, normal));
    let (sx, sy) = (OVERLAP * long.length(), OVERLAP * short.dot(y).abs());
    // An eighth of the long side keeps the splat visible from a grazing camera and below the needle
    // limit of 8 ... 10.
    let sizes = [sx, sy.max(sx / 8.0), sx / 8.0];
    splats.means.push(c.position.as_vec3().into());
    splats.log_scales.push(sizes.map(|s| s.max(1e-12).ln() as f32));
    splats.quats.push([q.w as f32, q.x as f32, q.y as f32, q.z as f32]);
    let faded = ((c.share - FADES_FROM) / (1.0 - FADES_FROM)).clamp(0.0, 1.0);
    let opacity = (OPACITY * (1.0 - faded)).max(LEAST_OPACITY);
    splats.opacity_logits.push((opacity / (1.0 - opacity)).ln() as f32);
    splats.sh.extend(c.colour.map(|v| (v - 0.5) / SH_C0));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Image, Pose};

    fn camera() -> Camera {
        Camera {
            name: "a".into(),
            width: 160,
            height: 120,
            fx: 140.0,
            fy: 140.0,
            cx: 80.0,
            cy: 60.0,
            pose: Pose::exp(DVec3::new(0.1, -0.2, 0.3), DVec3::new(0.2, 0.1, -0.1)),
        }
    }

    /// Image and depth of the world plane n·p = offset, with a small nearer object in the middle of
    /// the lower border.
    fn scene(n: DVec3, offset: f64) -> (RgbImage, DepthMap) {
        let camera = camera();
        let centre = camera.pose.centre();
        let mut image = RgbImage { width: 160, height: 120, data: Vec::new() };
        let mut depth = Image::filled(160, 120, 0.0f32);
        for i in 0..160 * 120 {
            let pixel = DVec2::new((i % 160) as f64 + 0.5, (i / 160) as f64 + 0.5);
            let ray = camera.pose.inverse().rotation * camera.ray(pixel);
            let object = pixel.distance(DVec2::new(80.0, 118.0)) < 5.0;
            let z = (offset - n.dot(centre)) / n.dot(ray);
            depth.data[i] = (if object { 0.7 * z } else { z }) as f32;
            image.data.push(if object { [1.0, 0.0, 0.0] } else { [0.2, 0.5, 0.7] });
        }
        let confidence = Image::filled(160, 120, 1.0);
        (image, DepthMap { depth, confidence })
    }

    #[test]
    fn unseen_splats_continue_a_plane() {
        let n = DVec3::new(0.1, -0.3, 1.0).normalize();
        let (image, depth) = scene(n, 3.0);
        let known = depth.clone();
        let splats = unseen_splats(&[image], &[camera()], &[depth], &[], 0.2, 0.5, usize::MAX, 0);
        // 32 px around 160 × 120 on a grid of 2.4 px is about 3100 cells (rounded corners).
        assert!(splats.len() > 2500, "{}", splats.len());
        let mut off = 0;
        for i in 0..splats.len() {
            let p = DVec3::from(splats.means[i].map(f64::from));
            let (pixel, z) = camera().project(p);
            let inside = pixel.x > 0.0 && pixel.y > 0.0 && pixel.x < 160.0 && pixel.y < 120.0;
            // Rounding may move a splat to the next pixel, whose surface it continues.
            let hidden = || z > 0.995 * f64::from(known.depth.at(pixel.x as usize, pixel.y as usize));
            assert!(!inside || hidden(), "before what the photo shows: {pixel} {z}");
            off +=
                usize::from((n.dot(p) - 3.0).abs() > 0.01 || (splats.sh[3 * i] * SH_C0 + 0.3).abs() > 0.02);
            let [w, x, y, z] = splats.quats[i].map(f64::from);
            let normal = DQuat::from_xyzw(x, y, z, w) * DVec3::Z;
            off += usize::from(normal.dot(n).abs() < 0.99);
        }
        // The object may continue itself at its own 10 of the 560 border pixels, 1.8 %.
        assert!(off <= splats.len() / 50, "{off} of {} leave the plane or its colour", splats.len());
    }

    #[test]
    fn unseen_splats_continue_behind_an_object() {
        let n = DVec3::new(0.1, -0.3, 1.0).normalize();
        let (mut image, mut depth) = scene(n, 3.0);
        let covered = |x: usize, y: usize| (60..100).contains(&x) && (45..75).contains(&y);
        for i in (0..160 * 120).filter(|i| covered(i % 160, i / 160)) {
            depth.depth.data[i] *= 0.6;
            image.data[i] = [0.9, 0.1, 0.1];
        }
        let splats = unseen_splats(&[image], &[camera()], &[depth], &[], 0.2, 0.5, usize::MAX, 0);
        let mut behind = 0;
        for (mean, sh) in splats.means.iter().zip(splats.sh.chunks(3)) {
            let p = DVec3::from(mean.map(f64::from));
            let (pixel, z) = camera().project(p);
            if !(pixel.x > 0.0 && pixel.y > 0.0 && covered(pixel.x as usize, pixel.y as usize)) {
                continue;
            }
            behind += 1;
            // On the plane, in its colour; the plane of the object has no surface in front of it.
            assert!((n.dot(p) - 3.0).abs() < 0.01, "{p} at {z}");
            assert!((sh[0] * SH_C0 + 0.3).abs() < 0.02, "{}", sh[0]);
        }
        // 40 × 30 px on a grid of 0.8 px, of which one in two to three remains, since splats share
        // cells in space.
        assert!(behind > 600, "{behind}");
    }

    /// Pixel and camera depth of every splat, and its red channel.
    fn places(splats: &Splats) -> Vec<(DVec2, f64, f32)> {
        let place = |(mean, sh): (&[f32; 3], &[f32])| {
            let (pixel, z) = camera().project(DVec3::from(mean.map(f64::from)));
            (pixel, z, 0.5 + sh[0] * SH_C0)
        };
        splats.means.iter().zip(splats.sh.chunks(3)).map(place).collect()
    }

    /// Photo of walls parallel to the image plane: depth and colour by pixel; depth 0 is unknown.
    fn walls(wall_at: impl Fn(usize, usize) -> (f32, [f32; 3])) -> (RgbImage, DepthMap) {
        let pixels: Vec<_> = (0..160 * 120).map(|i| wall_at(i % 160, i / 160)).collect();
        let depth = Image { width: 160, height: 120, data: pixels.iter().map(|p| p.0).collect() };
        let image = RgbImage { width: 160, height: 120, data: pixels.iter().map(|p| p.1).collect() };
        (image, DepthMap { depth, confidence: Image::filled(160, 120, 1.0) })
    }

    #[test]
    fn next_surface_continues_behind_the_first() {
        // A wall above and a nearer one below row 60: beyond the left border both continue, since
        // the nearer one may end.
        let (image, depth) = walls(|_, y| if y < 60 { (3.0, [0.2; 3]) } else { (1.8, [0.8; 3]) });
        let splats = unseen_splats(&[image], &[camera()], &[depth], &[], 0.2, 0.5, usize::MAX, 0);
        let below: Vec<_> = places(&splats)
            .into_iter()
            .filter(|(p, ..)| (-20.0..-1.0).contains(&p.x) && (63.0..75.0).contains(&p.y))
            .collect();
        let near = below.iter().filter(|(_, z, red)| (z - 1.8).abs() < 0.02 && *red > 0.7).count();
        let far = below.iter().filter(|(_, z, red)| (z - 3.0).abs() < 0.03 && *red < 0.3).count();
        // 19 × 12 px on a grid of 2.4 px are about 40 cells; some share a cell in space.
        assert!(near > 25 && far > 25 && near + far == below.len(), "{near} {far} {}", below.len());
    }

    #[test]
    fn border_without_depth_ignores_other_colours() {
        // Left: a grey wall without depth in the middle rows, and a red box before it.
        let (image, depth) = walls(|x, y| match (x, (30..90).contains(&y)) {
            (0..20, true) => (0.0, [0.5; 3]),
            (20..60, true) => (1.5, [0.9, 0.1, 0.1]),
            _ => (3.0, [0.5; 3]),
        });
        let splats = unseen_splats(&[image], &[camera()], &[depth], &[], 0.2, 0.5, usize::MAX, 0);
        let left: Vec<_> = places(&splats).into_iter().filter(|(p, ..)| p.x < -1.0).collect();
        assert!(left.len() > 500, "{}", left.len());
        for (pixel, z, red) in left {
            assert!((z - 3.0).abs() < 0.03 && red < 0.6, "{pixel} {z} {red}");
        }
    }

    #[test]
    fn sky_stays_behind_no_surface() {
        // A wall below a sky at ten times its distance, on a sphere around the camera.
        let (image, mut depth) = walls(|_, y| if y < 40 { (30.0, [0.6, 0.7, 0.9]) } else { (3.0, [0.3; 3]) });
        let centre = camera().pose.centre();
        for i in 0..160 * 40 {
            let pixel = DVec2::new((i % 160) as f64 + 0.5, (i / 160) as f64 + 0.5);
            depth.depth.data[i] *= (30.0 / camera().unproject(pixel, 30.0).distance(centre)) as f32;
        }
        let sky = Sky::of(&[camera()], std::slice::from_ref(&depth)).unwrap();
        assert!((sky.radius - 30.0).abs() < 1e-3, "{}", sky.radius);
        let splats = unseen_splats(&[image], &[camera()], &[depth.clone()], &[], 0.2, 0.5, usize::MAX, 0);
        let far: Vec<_> = places(&splats).into_iter().filter(|(_, z, _)| *z > 15.0).collect();
        assert!(far.len() > 100, "beyond the borders it continues");
        let inside = |p: &DVec2| (0.0..160.0).contains(&p.x) && (0.0..120.0).contains(&p.y);
        assert!(!far.iter().any(|(p, ..)| inside(p)));
        // A wall that recedes is no sky.
        depth.depth.data.iter_mut().enumerate().for_each(|(i, z)| *z = 30.0 - 0.2 * (i / 160) as f32);
        assert!(Sky::of(&[camera()], &[depth]).is_none());
    }

    #[test]
    fn wall_ends_where_another_photo_shows_its_end() {
        // The first photo cuts a wall off at its upper border. The second one, from farther up,
        // shows that it ends 5 pixels above, and what is far behind.
        let mut above = camera();
        above.pose.translation.y += 0.2;
        let rise = 140.0 * 0.2 / 2.0;
        let photos = [
            walls(|_, _| (2.0, [0.2; 3])),
            walls(|_, y| if (y as f64) < rise - 5.0 { (8.0, [0.8; 3]) } else { (2.0, [0.2; 3]) }),
        ];
        let (images, depths): (Vec<_>, Vec<_>) = photos.into_iter().unzip();
        let cameras = [camera(), above];
        let risen = |photos: usize| {
            let splats =
                unseen_splats(&images[..photos], &cameras, &depths[..photos], &[], 0.2, 0.5, usize::MAX, 0);
            let wall =
                |(p, z, _): &&(DVec2, f64, f32)| (40.0..120.0).contains(&p.x) && p.y < -6.0 && *z < 3.0;
            places(&splats).iter().filter(wall).count()
        };
        assert!(risen(1) > 100, "alone, the first photo continues it");
        assert_eq!(risen(2), 0);
    }

    #[test]
    fn unseen_splats_leave_other_photos_free() {
        let n = DVec3::Z;
        let (image, depth) = scene(n, 3.0);
        let mut beside = camera();
        // Rotated by 17°, with a part of the margin of the first in view.
        beside.pose = Pose::exp(DVec3::ZERO, DVec3::new(0.0, 0.3, 0.0)).compose(&beside.pose);
        // Its surfaces are farther away than the continuation of the first.
        let mut farther = depth.clone();
        farther.depth.data.iter_mut().for_each(|z| *z *= 1.5);
        let before = |splats: &Splats, camera: &Camera, depth: &DepthMap| {
            let stands = |p: &&[f32; 3]| {
                let (pixel, z) = camera.project(DVec3::from(p.map(f64::from)));
                let inside = (0.0..160.0).contains(&pixel.x) && (0.0..120.0).contains(&pixel.y) && z > 0.0;
                // Rounding may move a splat behind an edge to the next pixel, whose surface it
                // continues.
                inside && z < 0.98 * f64::from(depth.depth.at(pixel.x as usize, pixel.y as usize))
            };
            splats.means.iter().filter(stands).count()
        };
        let (images, depths) = ([image.clone(), image], [depth, farther]);
        let cameras = [camera(), beside];
        let alone = unseen_splats(&images[..1], &cameras, &depths[..1], &[], 0.2, 0.5, usize::MAX, 0);
        assert!(before(&alone, &cameras[1], &depths[1]) > 100, "the first photo alone knows no better");
        let splats = unseen_splats(&images, &cameras, &depths, &[], 0.2, 0.5, usize::MAX, 0);
        assert!(splats.len() > 1000);
        for (camera, depth) in cameras.iter().zip(&depths) {
            assert_eq!(before(&splats, camera, depth), 0);
        }
    }
}
