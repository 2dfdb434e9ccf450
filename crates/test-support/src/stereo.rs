//! Photos with exact depth, for tests of stereo.
use glam::{DMat3, DVec2, DVec3};
use splatvk_types::math::hash;
use splatvk_types::scene::{Camera, Image, Pose, RgbImage};
use std::path::Path;

/// Photos with exact depth.
pub struct Set {
    pub images: Vec<RgbImage>,
    pub cameras: Vec<Camera>,
    pub depth: Vec<Image<f32>>,
    pub sparse: Vec<DVec3>,
}

/// Smooth noise over the plane, three octaves down to about four pixels, so that every region can
/// be matched.
fn texture(u: f64, v: f64) -> f32 {
    let lattice = |x: i64, y: i64, octave: u32| {
        let h = hash(x as u32 ^ hash(y as u32 ^ hash(octave)));
        (h >> 8) as f64 / 16_777_216.0
    };
    let mut value = 0.0;
    for octave in 0..3u32 {
        let (x, y) = (u * (1 << octave) as f64, v * (1 << octave) as f64);
        let (fx, fy) = (x - x.floor(), y - y.floor());
        let (ix, iy) = (x.floor() as i64, y.floor() as i64);
        let (sx, sy) = (fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy));
        let top = lattice(ix, iy, octave) * (1.0 - sx) + lattice(ix + 1, iy, octave) * sx;
        let bottom = lattice(ix, iy + 1, octave) * (1.0 - sx) + lattice(ix + 1, iy + 1, octave) * sx;
        value += (top * (1.0 - sy) + bottom * sy) / 3.0;
    }
    value as f32
}

/// A slanted square in front of a slanted wall, seen by three cameras about 12° apart.
pub fn synthetic(width: u32, height: u32) -> Set {
    synthetic_from(width, height, 0.8)
}

/// Like [`synthetic`], with the outer cameras `reach` away from the middle one.
pub fn synthetic_from(width: u32, height: u32, reach: f64) -> Set {
    let f = 1.1 * width as f64;
    let cameras: Vec<Camera> = [-reach, 0.0, reach]
        .iter()
        .enumerate()
        .map(|(i, &x)| Camera {
            name: format!("{i}"),
            width,
            height,
            fx: f,
            fy: f,
            cx: width as f64 / 2.0,
            cy: height as f64 / 2.0,
            // Rotated about the vertical axis towards the point 4 units ahead.
            pose: Pose {
                rotation: DMat3::from_rotation_y((x / 4.0f64).atan()),
                translation: -(DMat3::from_rotation_y((x / 4.0f64).atan()) * DVec3::new(x, 0.1 * x, 0.0)),
            },
        })
        .collect();
    // (normal, offset) of the wall and of the square's plane.
    let planes = [(DVec3::new(0.2, 0.1, 1.0), 4.5), (DVec3::new(-0.3, 0.2, 1.0), 3.3)];
    let mut set = Set { images: vec![], cameras: cameras.clone(), depth: vec![], sparse: vec![] };
    for camera in &cameras {
        let mut image = RgbImage { width: width as usize, height: height as usize, data: vec![] };
        let mut depth = Image::filled(width as usize, height as usize, 0.0f32);
        let (eye, to_world) = (camera.pose.centre(), camera.pose.inverse().rotation);
        for k in 0..(width * height) as usize {
            let pixel = DVec2::new((k as u32 % width) as f64 + 0.5, (k as u32 / width) as f64 + 0.5);
            let ray = to_world * camera.ray(pixel);
            let hit = |(normal, offset): (DVec3, f64)| (offset - normal.dot(eye)) / normal.dot(ray);
            let near = eye + ray * hit(planes[1]);
            let on_square = near.x.abs() < 0.7 && near.y.abs() < 0.5;
            let z = if on_square { hit(planes[1]) } else { hit(planes[0]) };
            let p = eye + ray * z;
            // Base period of 16 pixels at a depth of 4 for 160-pixel photos.
            let period = 16.0 * 4.0 / (1.1 * 160.0);
            let shade = texture(p.x / period + 100.0 * on_square as u8 as f64, p.y / period);
            // Two tints, so that filling meets an edge.
            let tint = if on_square { [1.0, 0.6, 0.5] } else { [0.6, 0.8, 1.0] };
            image.data.push(tint.map(|t: f32| (t * (0.2 + 0.8 * shade) * 255.0).round() / 255.0));
            depth.data[k] = z as f32;
            if k % 97 == 0 {
                set.sparse.push(p);
            }
        }
        set.images.push(image);
        set.depth.push(depth);
    }
    set
}

/// Sorted relative depth errors, and the share of pixels with depth.
pub fn errors(found: &Image<f32>, exact: &Image<f32>) -> (Vec<f32>, f32) {
    let mut errors: Vec<f32> = found
        .data
        .iter()
        .zip(&exact.data)
        .filter(|(f, e)| **f > 0.0 && **e > 0.0)
        .map(|(f, e)| (f - e).abs() / e)
        .collect();
    errors.sort_by(f32::total_cmp);
    let known = exact.data.iter().filter(|e| **e > 0.0).count();
    let share = errors.len() as f32 / known as f32;
    (errors, share)
}

pub fn within(errors: &[f32], limit: f32) -> f32 {
    errors.iter().filter(|&&e| e < limit).count() as f32 / errors.len() as f32
}

/// Training views of breakfast, reduced by the factor `shrink`, with exact cameras and 60 exact
/// points per view.
pub fn breakfast(shrink: u32) -> Set {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/breakfast");
    let truth = std::fs::read_to_string(root.join("ground_truth.json")).unwrap();
    let truth: serde_json::Value = serde_json::from_str(&truth).unwrap();
    let mut set = Set { images: vec![], cameras: vec![], depth: vec![], sparse: vec![] };
    for frame in truth["frames"].as_array().unwrap().iter().filter(|f| f["split"] == "train") {
        let file = frame["file"].as_str().unwrap();
        let number = |key: &str| frame[key].as_f64().unwrap();
        let m = |r: usize, c: usize| frame["world_to_camera"][r][c].as_f64().unwrap();
        let photo = image::open(root.join(file)).unwrap().to_rgb8();
        let camera = Camera {
            name: file.into(),
            width: photo.width(),
            height: photo.height(),
            fx: number("fx"),
            fy: number("fy"),
            cx: number("cx"),
            cy: number("cy"),
            pose: Pose {
                rotation: DMat3::from_cols_array_2d(&[0, 1, 2].map(|c| [m(0, c), m(1, c), m(2, c)])),
                translation: DVec3::new(m(0, 3), m(1, 3), m(2, 3)),
            },
        };
        let stem = Path::new(file).file_stem().unwrap().to_str().unwrap();
        let depth = splatvk_io::format::npy::read_npz(root.join(format!("depth/{stem}.npz"))).unwrap();
        let depth = depth["depth"].to_f32();
        let width = camera.width;
        for k in (0..depth.len()).step_by(depth.len() / 60) {
            if depth[k] > 0.0 {
                let pixel = DVec2::new((k as u32 % width) as f64 + 0.5, (k as u32 / width) as f64 + 0.5);
                set.sparse.push(camera.unproject(pixel, depth[k] as f64));
            }
        }
        let (w, h) = (width / shrink, camera.height / shrink);
        let small = image::imageops::resize(&photo, w, h, image::imageops::FilterType::Triangle);
        let data = small.pixels().map(|p| p.0.map(|v| v as f32 / 255.0)).collect();
        set.images.push(RgbImage { width: w as usize, height: h as usize, data });
        let sampled = (0..(w * h) as usize).map(|k| {
            let (x, y) = (k as u32 % w * shrink + shrink / 2, k as u32 / w * shrink + shrink / 2);
            depth[(y * width + x) as usize]
        });
        set.depth.push(Image { width: w as usize, height: h as usize, data: sampled.collect() });
        set.cameras.push(camera.resized(w, h));
    }
    set
}
