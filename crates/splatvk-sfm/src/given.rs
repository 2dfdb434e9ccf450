//! Given cameras assigned to their photos: joined by name, rotated by the EXIF orientation, scaled
//! to working size, with the distortion taken out of the photos.
use super::matching::{Keypoints, Match, mutual_matches, valid_area};
use super::minimal::{essential, triangulate_two};
use super::sift;
use super::two_view::sampson;
use crate::photo::{Photo, join};
use crate::progress::Progress;
use crate::scene::{Camera, GivenCamera, Lens};
use crate::{Error, Result, files};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// Pixel frame of a given camera, for photos with an EXIF orientation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pixels {
    /// Pixels as stored in the file. COLMAP does not apply the orientation (colmap#1456), nor do
    /// most programs that build on it.
    Stored,
    /// Pixels after the orientation, as viewers show them.
    Upright,
}

/// Assigns `given` cameras to photos and undistorts these. Returns pinhole cameras at working
/// resolution. A camera of the stored pixels is rotated by the EXIF orientation, and a photo
/// mirrored by its orientation is mirrored back. The error names a photo without a camera, or with
/// one of another aspect ratio.
pub fn assign(photos: &mut [Photo], given: &[GivenCamera], progress: &dyn Progress) -> Result<Vec<Camera>> {
    let own = joined(photos, given)?;
    let pixels = pixels(photos, &own, progress)?;
    let turned =
        photos.iter().zip(&pixels).filter(|(p, pixels)| !p.turn.is_none() && **pixels == Pixels::Stored);
    let turned: Vec<&str> = turned.map(|(p, _)| p.stem.as_str()).collect();
    if !turned.is_empty() {
        progress.inform(&format!(
            "the cameras are those of the stored pixels, without the EXIF orientation; they are turned with the photos: {}",
            files::listed(&turned)
        ));
    }
    let mut cameras = Vec::with_capacity(photos.len());
    let mut strongest = 0.0f64;
    for ((photo, own), pixels) in photos.iter_mut().zip(own).zip(pixels) {
        let GivenCamera { camera, lens } = at_working_size(photo, own, pixels);
        if pixels == Pixels::Stored && photo.turn.mirrored {
            photo.unmirror();
        }
        photo.straighten(lens, &camera);
        let share = corner_distortion(&lens, &camera);
        strongest = if share.abs() > strongest.abs() { share } else { strongest };
        cameras.push(camera);
    }
    if strongest != 0.0 {
        progress.inform(&format!(
            "lenses of the camera file are taken out of the photos: up to {:+.1} % of the radius at the corner",
            100.0 * strongest
        ));
    }
    Ok(cameras)
}

/// Radial displacement of the first image corner by the lens, as a share of its distance from the
/// principal point.
fn corner_distortion(lens: &Lens, camera: &Camera) -> f64 {
    let corner = camera.ray(DVec2::ZERO).truncate();
    lens.distort(corner).length() / corner.length() - 1.0
}

/// Camera of each photo, joined by file name.
fn joined<'a>(photos: &[Photo], given: &'a [GivenCamera]) -> Result<Vec<&'a GivenCamera>> {
    let names: Vec<&str> = given.iter().map(|c| c.camera.name.as_str()).collect();
    let paths: Vec<String> = photos.iter().map(|p| p.path.to_string_lossy().into_owned()).collect();
    let found = join(&paths, &names).map_err(Error::input)?;
    let missing = |photo: &Photo| {
        Error::input(format!(
            "{}: the camera file has no camera of this name; it names {}",
            photo.path.display(),
            files::listed(&names)
        ))
    };
    let cameras = photos.iter().zip(found);
    cameras.map(|(photo, found)| found.map(|k| &given[k]).ok_or_else(|| missing(photo))).collect()
}

/// Largest relative difference of equal aspect ratios: sides of working images and of reduced
/// copies are rounded to whole pixels.
const SAME_ASPECT: f64 = 0.01;

/// Pixel frame of each camera: from its image size, else from that of the other photos, else from
/// matches.
fn pixels(photos: &[Photo], own: &[&GivenCamera], progress: &dyn Progress) -> Result<Vec<Pixels>> {
    let known = photos.iter().zip(own).map(|(p, c)| by_size(p, &c.camera)).collect::<Result<Vec<_>>>()?;
    let open: Vec<usize> = (0..photos.len()).filter(|v| known[*v].is_none()).collect();
    if open.is_empty() {
        return Ok(known.into_iter().flatten().collect());
    }
    // One program wrote the file and treated all photos alike. Photos without an orientation are no
    // evidence.
    let is_used = |pixels| known.iter().zip(photos).any(|(t, p)| *t == Some(pixels) && !p.turn.is_none());
    let all = match (is_used(Pixels::Stored), is_used(Pixels::Upright)) {
        (true, false) => Pixels::Stored,
        (false, true) => Pixels::Upright,
        _ => by_matches(photos, own, &known).unwrap_or_else(|| {
            let names: Vec<&str> = open.iter().map(|v| photos[*v].stem.as_str()).collect();
            progress.warn(&format!(
                "neither sizes nor matches show whether the cameras of {} belong to the stored pixels or to the upright ones (EXIF \
                 orientation); taken as stored, as COLMAP does: if the scene is wrong, save the photos without EXIF",
                files::listed(&names)
            ));
            Pixels::Stored
        }),
    };
    Ok(known.into_iter().map(|t| t.unwrap_or(all)).collect())
}

/// Pixel frame from the image size of a camera; `None` where both are possible. The error names a
/// photo of another aspect ratio.
fn by_size(photo: &Photo, camera: &Camera) -> Result<Option<Pixels>> {
    if photo.turn.is_none() && fits(camera, photo.original_size) {
        return Ok(Some(Pixels::Upright));
    }
    let (upright, size) = (photo.original_size, (camera.width, camera.height));
    let stored = photo.turn.stored(upright);
    if stored != upright && (size == stored || size == upright) {
        return Ok(Some(if size == stored { Pixels::Stored } else { Pixels::Upright }));
    }
    match (fits(camera, stored), fits(camera, upright)) {
        (true, true) => Ok(None),
        (true, false) => Ok(Some(Pixels::Stored)),
        (false, true) => Ok(Some(Pixels::Upright)),
        (false, false) => {
            let turn = match photo.turn.is_none() {
                true => String::new(),
                false => {
                    format!(" ({}×{} as stored, EXIF orientation {})", stored.0, stored.1, photo.turn.exif())
                }
            };
            Err(Error::input(format!(
                "{}: camera {} is for {}×{} pixels, the photo is {}×{}{turn}: the aspects differ; give the photos that the \
                 cameras were made of",
                photo.path.display(),
                camera.name,
                camera.width,
                camera.height,
                upright.0,
                upright.1
            )))
        }
    }
}

fn fits(camera: &Camera, (w, h): (u32, u32)) -> bool {
    let (a, b) = (f64::from(camera.width) * f64::from(h), f64::from(camera.height) * f64::from(w));
    (a / b - 1.0).abs() <= SAME_ASPECT
}

/// Rotates a given camera into the frame of the upright photo and scales it to working resolution.
fn at_working_size(photo: &Photo, own: &GivenCamera, pixels: Pixels) -> GivenCamera {
    let quarters = if pixels == Pixels::Stored { photo.turn.quarters } else { 0 };
    let GivenCamera { camera, lens } = own.turned(quarters);
    let size = (photo.image.width as u32, photo.image.height as u32);
    let to_working = match pixels == Pixels::Stored && photo.turn.mirrored {
        true => photo.mirrored_to_working(),
        false => photo.to_working,
    };
    let whole = photo.original_size;
    let camera = match (camera.width, camera.height) == whole {
        true => to_working.camera(&camera, size),
        false => to_working.camera(&camera.resized(whole.0, whole.1), size),
    };
    GivenCamera { camera, lens }
}

/// Most photos matched, in all pairs, to decide between the pixel frames.
const MATCHED: usize = 6;
/// Long side of the images matched, pixels.
const SIDE: usize = 480;
/// Most corners per image.
const CORNERS: usize = 500;
/// Lowe's ratio test.
const RATIO: f32 = 0.85;
/// Largest distance from the epipolar line, share of the long side (2 pixels of 480).
const NEAR: f64 = 2.0 / 480.0;
/// Fewest inliers for a decision.
const ENOUGH: usize = 30;
/// Least ratio of the inliers of the two pixel frames for a decision.
const CLEARLY: f64 = 1.5;

/// Pixel frame in which clearly more matches are inliers; `None` without a clear one. Inliers are
/// near their epipolar lines and in front of both cameras.
fn by_matches(photos: &[Photo], own: &[&GivenCamera], known: &[Option<Pixels>]) -> Option<Pixels> {
    let mut views: Vec<usize> = (0..photos.len()).collect();
    views.sort_by_key(|v| known[*v].is_some());
    views.truncate(MATCHED);
    let corners: Vec<Keypoints> = views.par_iter().map(|v| detect(&photos[*v])).collect();
    let pairs: Vec<(usize, usize)> =
        (0..views.len()).flat_map(|i| (i + 1..views.len()).map(move |j| (i, j))).collect();
    let inliers = |(i, j): &(usize, usize)| -> [usize; 2] {
        let (a, b) = (views[*i], views[*j]);
        if known[a].is_some() && known[b].is_some() {
            return [0, 0];
        }
        let matches = mutual_matches(&corners[*i], &corners[*j], RATIO);
        [Pixels::Stored, Pixels::Upright].map(|pixels| {
            let frame = |v: usize| known[v].unwrap_or(pixels);
            let first = framed_camera(&photos[a], own[a], frame(a));
            let second = framed_camera(&photos[b], own[b], frame(b));
            count_inliers(&matches, (&corners[*i], &first), (&corners[*j], &second))
        })
    };
    let counts: Vec<[usize; 2]> = pairs.par_iter().map(inliers).collect();
    let [stored, upright] = [0, 1].map(|k| counts.iter().map(|c| c[k]).sum::<usize>());
    let wins = |a: usize, b: usize| a >= ENOUGH && a as f64 > CLEARLY * b as f64;
    match (wins(stored, upright), wins(upright, stored)) {
        (true, _) => Some(Pixels::Stored),
        (_, true) => Some(Pixels::Upright),
        _ => None,
    }
}

/// Corners of a photo in working pixels, detected on an image of long side [`SIDE`].
fn detect(photo: &Photo) -> Keypoints {
    let image = &photo.image;
    let share = (SIDE as f64 / image.width.max(image.height) as f64).min(1.0);
    let to = |n: usize| ((n as f64 * share).round() as usize).max(1);
    let small = image.resized_by_area(to(image.width), to(image.height));
    let mut found = sift::detect(&small.luma(), &valid_area(&small, Default::default(), None, 4), CORNERS);
    let back = DVec2::new(image.width as f64 / small.width as f64, image.height as f64 / small.height as f64);
    found.points.iter_mut().for_each(|p| *p *= back);
    found
}

/// A camera; `mirrored` where its pixels are those of the mirrored photo.
struct FramedCamera {
    given: GivenCamera,
    mirrored: bool,
}

fn framed_camera(photo: &Photo, own: &GivenCamera, pixels: Pixels) -> FramedCamera {
    FramedCamera {
        given: at_working_size(photo, own, pixels),
        mirrored: pixels == Pixels::Stored && photo.turn.mirrored,
    }
}

impl FramedCamera {
    fn ray(&self, p: DVec2) -> DVec3 {
        let GivenCamera { camera, lens } = &self.given;
        let x = if self.mirrored { f64::from(camera.width) - p.x } else { p.x };
        lens.ray(camera, DVec2::new(x, p.y))
    }
}

/// Number of matches near their epipolar lines and in front of both cameras.
fn count_inliers(
    matches: &[Match],
    (a, from): (&Keypoints, &FramedCamera),
    (b, to): (&Keypoints, &FramedCamera),
) -> usize {
    let (first, second) = (&from.given.camera, &to.given.camera);
    let pose = second.pose.compose(&first.pose.inverse());
    let between = essential(&pose);
    let near = NEAR * f64::from(first.width.max(first.height)) / first.fx;
    let is_inlier = |m: &&Match| {
        let (x, y) = (from.ray(a.points[m.first]), to.ray(b.points[m.second]));
        let in_front = triangulate_two(&pose, x, y).is_some_and(|p| p.z > 0.0 && pose.transform(p).z > 0.0);
        in_front && sampson(&between, x.truncate(), y.truncate()) < near * near
    };
    matches.iter().filter(is_inlier).count()
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;
    use crate::photo::{PlainBorder, Turn, from_pixels};
    use crate::progress::{Recorded, Silent};
    use crate::scene::{Pose, RgbImage};

    fn photo(width: usize, height: usize, quarters: u8) -> Photo {
        let image = RgbImage { width, height, data: vec![[0.5; 3]; width * height] };
        let photo = from_pixels("a.png".as_ref(), &image, None, width.max(height)).unwrap();
        Photo { turn: Turn { quarters, mirrored: false }, ..photo }
    }

    fn camera(width: u32, height: u32) -> GivenCamera {
        let (name, pose) = ("a.jpg".to_string(), Pose::IDENTITY);
        Camera { name, width, height, fx: 100.0, fy: 110.0, cx: 60.0, cy: 50.0, pose }.into()
    }

    #[test]
    fn assign_scales_cameras_without_stretching() {
        let of = |w, h| assign(&mut [photo(80, 64, 0)], &[camera(w, h)], &Silent);
        let half = &of(160, 128).unwrap()[0];
        assert_eq!((half.width, half.height, half.fx, half.cx, half.cy), (80, 64, 50.0, 30.0, 25.0));
        let error = of(128, 128).unwrap_err();
        assert!(error.exit_code() == 2 && error.to_string().contains("the aspects differ"), "{error}");
    }

    #[test]
    fn assign_cut_photo_uses_file_size() {
        let cut = |mirrored| {
            let mut photo = Photo { turn: Turn { quarters: 0, mirrored }, ..photo(160, 128, 0) };
            photo.cut(PlainBorder { left: 20, top: 8, right: 0, bottom: 0 });
            let camera = assign(&mut [photo], &[camera(80, 64)], &Silent).unwrap().remove(0);
            (camera.width, camera.height, camera.fx, camera.cx, camera.cy)
        };
        assert_eq!(cut(false), (140, 120, 200.0, 100.0, 92.0));
        // The left bar is on the right in the stored pixels of the camera.
        assert_eq!(cut(true), (140, 120, 200.0, 120.0, 92.0));
    }

    #[test]
    fn assign_rotates_cameras_of_stored_size() {
        // Upright 64 × 80, stored 80 × 64: cameras of the stored aspect ratio are rotated, at both
        // sizes.
        for (w, h, fx) in [(80, 64, 110.0), (160, 128, 55.0)] {
            let turned = &assign(&mut [photo(64, 80, 1)], &[camera(w, h)], &Silent).unwrap()[0];
            assert_eq!((turned.width, turned.height, turned.fx), (64, 80, fx));
        }
        let upright = &assign(&mut [photo(64, 80, 1)], &[camera(64, 80)], &Silent).unwrap()[0];
        assert_eq!((upright.fx, upright.cx), (100.0, 60.0));
        let e = assign(&mut [photo(64, 80, 1)], &[camera(90, 90)], &Silent).unwrap_err().to_string();
        assert!(e.contains("80×64 as stored, EXIF orientation 6"), "{e}");
    }

    #[test]
    fn pixels_equal_aspect_decided_by_matches() {
        let truth = testing::train(&testing::folder());
        let size = (truth.photos[0].image.width as f64, truth.photos[0].image.height as f64);
        for mirrored in [false, true] {
            // The files store the photos upside down or mirrored, with the EXIF tag that undoes it.
            let turn = if mirrored { Turn { quarters: 0, mirrored } } else { Turn { quarters: 2, mirrored } };
            let photos: Vec<Photo> = truth.photos.iter().map(|p| Photo { turn, ..p.clone() }).collect();
            let upright: Vec<GivenCamera> = truth.cameras.iter().cloned().map(GivenCamera::from).collect();
            // Cameras of the stored pixels: rotated by 180°, or of the mirrored world.
            let stored: Vec<GivenCamera> = match mirrored {
                false => upright.iter().map(|c| c.turned(2)).collect(),
                true => truth.cameras.iter().map(|c| in_a_mirror(c, size.0).into()).collect(),
            };
            let choice = |given: &[GivenCamera]| {
                let recorded = Recorded::new(&Silent);
                let own: Vec<&GivenCamera> = given.iter().collect();
                let found = pixels(&photos, &own, &recorded).unwrap();
                assert!(recorded.warnings().is_empty());
                found
            };
            assert_eq!(choice(&stored), [Pixels::Stored; 4], "{mirrored}");
            assert_eq!(choice(&upright), [Pixels::Upright; 4], "{mirrored}");
            let mut placed = photos.clone();
            let cameras = assign(&mut placed, &stored, &Silent).unwrap();
            let off = (cameras[1].pose.centre() - stored[1].camera.pose.centre()).length();
            assert!(off < 1e-12 && !placed[0].turn.mirrored);
            let row = &photos[0].image.data[..photos[0].image.width];
            let first = if mirrored { row[row.len() - 1] } else { row[0] };
            assert_eq!(placed[0].image.data[0], first);
        }
    }

    /// Camera of the mirrored photo in the mirrored world.
    fn in_a_mirror(camera: &Camera, width: f64) -> Camera {
        let mirror = glam::DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0));
        let pose = Pose {
            rotation: mirror * camera.pose.rotation * mirror,
            translation: mirror * camera.pose.translation,
        };
        Camera { cx: width - camera.cx, pose, ..camera.clone() }
    }

    #[test]
    fn assign_blank_photos_warns_of_orientation() {
        let photos = [photo(80, 64, 2), Photo { path: "b.png".into(), stem: "b".into(), ..photo(80, 64, 2) }];
        let mut other = camera(80, 64);
        other.camera.name = "b.jpg".into();
        let recorded = Recorded::new(&Silent);
        assign(&mut photos.clone(), &[camera(80, 64), other], &recorded).unwrap();
        let warnings = recorded.warnings();
        assert!(warnings.len() == 1 && warnings[0].contains("stored pixels"), "{warnings:?}");
    }

    #[test]
    fn assign_removes_given_lens_distortion() {
        let truth = testing::train(&testing::folder());
        let camera = &truth.cameras[0];
        for lens in [
            Lens { p1: 0.002, p2: -0.001, ..Lens::radial(-0.1, 0.02) },
            Lens { k3: 0.001, fisheye: true, ..Lens::radial(0.01, 0.0) },
        ] {
            let mut seen = [testing::lensed(&truth.photos[0], camera.fx, lens)];
            let given =
                GivenCamera { camera: Camera { name: "train_00.jpg".into(), ..camera.clone() }, lens };
            assign(&mut seen, &[given], &Silent).unwrap();
            let (w, h) = (camera.width as usize, camera.height as usize);
            let mut squares = 0.0;
            for y in h / 8..7 * h / 8 {
                for x in w / 8..7 * w / 8 {
                    let (a, b) = (seen[0].image.at(x, y), truth.photos[0].image.at(x, y));
                    squares += (0..3).map(|k| f64::from(a[k] - b[k]).powi(2)).sum::<f64>();
                }
            }
            let psnr = -10.0 * (squares / (3.0 * 0.75 * 0.75 * (w * h) as f64)).log10();
            // Interpolating twice costs the rest.
            assert!(psnr > 35.0, "{lens:?}: {psnr:.1} dB");
            assert_eq!(seen[0].lens(), lens);
        }
    }
}
