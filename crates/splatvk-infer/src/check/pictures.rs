//! Built-in pictures of a wall and of a box before it, with known matches between them.
//!
//! The cameras look straight at the wall and differ by a translation only. One step of the camera
//! to the right moves the wall by 20 pixels and the box by 60 to the left, so the wall is three
//! times as far away.
use std::sync::OnceLock;

use crate::math::Random;
use crate::photo::{self, Photo};
use crate::scene::RgbImage;

pub(super) const WIDTH: usize = 640;
pub(super) const HEIGHT: usize = 480;
/// Edges of the box in the first picture, pixels.
const BOX_X: [f64; 2] = [260.0, 420.0];
const BOX_Y: [f64; 2] = [160.0, 330.0];
/// Least distance of measured pixels from the border of their surface: networks of 14 or 16 pixel
/// patches blur depth and matches over about one patch.
const MARGIN: f64 = 16.0;

/// A surface of the pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Surface {
    Wall,
    Box,
}

impl Surface {
    /// Pixels that it moves by to the left when the camera moves one step to the right.
    pub fn disparity(self) -> f64 {
        match self {
            Surface::Wall => 20.0,
            Surface::Box => 60.0,
        }
    }
}

/// Pictures of `count` cameras at different places. The second is one step to the right of the
/// first, the others lie around them.
pub(super) fn pictures(count: usize) -> Vec<Photo> {
    (0..count).map(|k| photo::of_image(format!("built-in {k}").as_ref(), picture(place(k)))).collect()
}

/// Place of a camera, steps to the right and down; twentieths, which are whole pixels.
pub(super) fn place(k: usize) -> [f64; 2] {
    match k {
        0 => [0.0, 0.0],
        1 => [1.0, 0.0],
        // Multiples of irrational numbers are spread evenly; the box stays inside of the picture.
        _ => {
            let spread = [(0.618_034 * k as f64).fract() * 2.0 - 0.5, (0.754_878 * k as f64).fract() - 0.5];
            spread.map(|steps| (20.0 * steps).round() / 20.0)
        }
    }
}

/// Surface of a pixel of the first (0) or second (1) picture, if it is at least [`MARGIN`] away
/// from the border of the surface and its match lies in the other picture, as far from all borders.
pub(super) fn surface(picture: usize, x: f64, y: f64) -> Option<Surface> {
    let step = picture as f64;
    let other = 1.0 - 2.0 * step;
    let seen = |surface: Surface| {
        let moved = x - other * surface.disparity();
        [x, moved].iter().all(|x| (MARGIN..WIDTH as f64 - MARGIN).contains(x))
            && on(x, y, step) == Some(surface)
            && on(moved, y, 1.0 - step) == Some(surface)
    };
    [Surface::Wall, Surface::Box].into_iter().find(|s| seen(*s))
}

/// Surface at a pixel of the camera `step` steps to the right, `None` near its border.
fn on(x: f64, y: f64, step: f64) -> Option<Surface> {
    let x = x + step * Surface::Box.disparity();
    let inside = |grown: f64| {
        (BOX_X[0] - grown..BOX_X[1] + grown).contains(&x) && (BOX_Y[0] - grown..BOX_Y[1] + grown).contains(&y)
    };
    match (inside(-MARGIN), inside(MARGIN)) {
        (true, _) => Some(Surface::Box),
        (_, false) => Some(Surface::Wall),
        _ => None,
    }
}

fn picture(place: [f64; 2]) -> RgbImage {
    let [wall, near] = [Surface::Wall, Surface::Box].map(|surface| {
        let by = place.map(|steps| steps * surface.disparity());
        move |p: usize| [(p % WIDTH) as f64 + by[0], (p / WIDTH) as f64 + by[1]]
    });
    let pixel = |p: usize| {
        let [u, v] = near(p);
        let inside = (BOX_X[0]..BOX_X[1]).contains(&u) && (BOX_Y[0]..BOX_Y[1]).contains(&v);
        if inside { texture(Surface::Box, [u, v]) } else { texture(Surface::Wall, wall(p)) }
    };
    RgbImage { width: WIDTH, height: HEIGHT, data: (0..WIDTH * HEIGHT).map(pixel).collect() }
}

/// Longest wavelength of a texture, pixels.
const LONGEST: usize = 64;
/// Size of a texture: the first picture with a border of [`LONGEST`].
const TEXTURE: [usize; 2] = [WIDTH + 2 * LONGEST, HEIGHT + 2 * LONGEST];

/// Colour of a surface at whole pixels of the first picture.
fn texture(surface: Surface, at: [f64; 2]) -> [f32; 3] {
    static ALL: OnceLock<[Vec<[f32; 3]>; 2]> = OnceLock::new();
    let all = ALL.get_or_init(|| [mottled([0.66, 0.60, 0.50], 1), mottled([0.30, 0.38, 0.55], 2)]);
    let [x, y] = at.map(|v| (v + LONGEST as f64).round() as usize);
    all[surface as usize][y * TEXTURE[0] + x]
}

/// A texture of the mean colour `base` with random brightness and tint.
fn mottled(base: [f32; 3], seed: u64) -> Vec<[f32; 3]> {
    let mut random = Random::new(seed);
    let (light, tint) = (fractal(&mut random), fractal(&mut random));
    let colour = |(light, tint): (f32, f32)| {
        let tints = [0.1 * tint, 0.0, -0.1 * tint];
        [0, 1, 2].map(|c| (base[c] * (1.0 + light) + tints[c]).clamp(0.0, 1.0))
    };
    light.into_iter().zip(tint).map(colour).collect()
}

/// Noise of about ±0.5 whose amplitude is proportional to the wavelength, as in photographs
/// (Field 1987). It does not repeat, so that every pixel has one match.
fn fractal(random: &mut Random) -> Vec<f32> {
    let mut sum = vec![0.0; TEXTURE[0] * TEXTURE[1]];
    for size in [LONGEST, LONGEST / 2, LONGEST / 4, LONGEST / 8, LONGEST / 16] {
        let [columns, rows] = TEXTURE.map(|n| n.div_ceil(size) + 1);
        let amplitude = 0.45 * size as f64 / LONGEST as f64;
        let values: Vec<f64> = (0..columns * rows).map(|_| random.between(-amplitude, amplitude)).collect();
        for (p, total) in sum.iter_mut().enumerate() {
            let (x, y) = (p % TEXTURE[0], p / TEXTURE[0]);
            let corner = y / size * columns + x / size;
            let [s, t] = [x, y].map(|v| smooth((v % size) as f64 / size as f64));
            let row = |k: usize| values[k] + s * (values[k + 1] - values[k]);
            *total += (row(corner) + t * (row(corner + columns) - row(corner))) as f32;
        }
    }
    sum
}

/// From 0 to 1 without a slope at either end.
fn smooth(t: f64) -> f64 {
    t * t * (3.0 - 2.0 * t)
}
