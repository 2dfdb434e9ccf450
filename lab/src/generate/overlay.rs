//! Overlays drawn over every photo of a set at the same place: watermarks, captions, frames, a
//! bonnet.
use super::spoil::Spoil;
use rayon::prelude::*;
use splatvk::scene::RgbImage;

/// Rows and columns of cells of a letter, without the gap to the next one.
const LETTER: (usize, usize) = (7, 5);
const WHITE: [f32; 3] = [0.98; 3];
const BLACK: [f32; 3] = [0.06; 3];
const RED: [f32; 3] = [0.65, 0.05, 0.1];

impl Spoil {
    /// Draws the overlay of this variant over a photo, at the same place in every photo; variants
    /// without an overlay draw nothing.
    pub fn draw_over(self, image: &mut RgbImage) {
        let (w, h) = (image.width, image.height);
        image.data.par_iter_mut().enumerate().for_each(|(i, colour)| {
            let position = [(i % w) as f64 + 0.5, (i / w) as f64 + 0.5].map(|v| v / h as f64);
            if let Some((ink, alpha)) = ink(self, position, w as f64 / h as f64) {
                *colour = std::array::from_fn(|c| alpha * ink[c] + (1.0 - alpha) * colour[c]);
            }
        });
    }
}

/// Colour and opacity of the overlay at a position, in units of the frame's height; the frame is
/// `width` wide.
fn ink(spoil: Spoil, [x, y]: [f64; 2], width: f64) -> Option<([f32; 3], f32)> {
    let opaque = |colour| Some((colour, 1.0));
    // A line of letters on a plain ground: it starts at `left` and is `height` high.
    let sign = |[left, top]: [f64; 2], height: f64, letters: f64, ink, ground| {
        opaque(if is_stroke([(x - left) / height, (y - top) / height], letters) { ink } else { ground })
    };
    match spoil {
        Spoil::Watermark => {
            let (s, c) = 20f64.to_radians().sin_cos();
            let (along, down) = (c * x + s * y + 2.0, c * y - s * x + 2.0);
            let row = (down / 0.22).floor();
            let in_line = [(along + 0.37 * row).rem_euclid(0.6) / 0.09, (down - 0.22 * row) / 0.09];
            is_stroke(in_line, 6.0).then_some((WHITE, 0.4))
        }
        Spoil::Caption if y < 0.11 => sign([0.02, 0.02], 0.07, 18.0, WHITE, BLACK),
        Spoil::Caption if y > 0.9 => sign([0.02, 0.92], 0.06, 20.0, RED, WHITE),
        Spoil::Banner if y > 0.85 && x < 0.2 * width => sign([0.03, 0.89], 0.07, 3.0, RED, WHITE),
        Spoil::Banner if y > 0.85 => sign([0.23 * width, 0.89], 0.06, 16.0, WHITE, RED),
        Spoil::Letterbox if !(0.125..0.875).contains(&y) => opaque([0.0; 3]),
        Spoil::Frame if !(0.06..0.87).contains(&y) || x < 0.12 || x > width - 0.12 => opaque([1.0; 3]),
        Spoil::Screenshot if y < 0.25 => sign([0.05, 0.02], 0.04, 5.0, WHITE, [0.0; 3]),
        Spoil::Screenshot if y > 0.75 => sign([0.1, 0.9], 0.05, 20.0, WHITE, [0.0; 3]),
        Spoil::Bonnet => {
            let edge = 0.78 + 0.12 * (2.0 * x / width - 1.0).powi(2);
            let flake = hash((x * 90.0) as usize, (y * 90.0) as usize) % 64;
            let shade = 0.3 + 0.2 * (1.0 - y) as f32 + 0.0015 * flake as f32;
            (y > edge).then_some(([shade, shade, 1.1 * shade], 1.0))
        }
        _ => None,
    }
}

/// Whether a position lies on a stroke of made-up letters. It is in units of their height, from the
/// upper left corner of the first letter.
fn is_stroke([u, v]: [f64; 2], letters: f64) -> bool {
    let (rows, columns) = LETTER;
    let size = columns as f64 + 1.0;
    let column = u * rows as f64;
    let row = v * rows as f64;
    if column < 0.0 || row < 0.0 || row >= rows as f64 || column >= letters * size {
        return false;
    }
    let (letter, cell) = ((column / size) as usize, (column % size) as usize);
    cell < columns && hash(letter, cell * rows + row as usize).is_multiple_of(2)
}

fn hash(a: usize, b: usize) -> u64 {
    let mut z = (a as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15)
        ^ (b as u64 + 1).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 30)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draw_over_covers_same_pixels() {
        let drawn = |spoil: Spoil, v: f32| {
            let mut image = RgbImage { width: 160, height: 120, data: vec![[v; 3]; 160 * 120] };
            spoil.draw_over(&mut image);
            image
        };
        for (spoil, least, most) in [
            (Spoil::Watermark, 0.04, 0.3),
            (Spoil::Caption, 0.19, 0.22),
            (Spoil::Banner, 0.14, 0.16),
            (Spoil::Letterbox, 0.24, 0.26),
            (Spoil::Frame, 0.3, 0.35),
            (Spoil::Screenshot, 0.49, 0.51),
            (Spoil::Bonnet, 0.1, 0.2),
            (Spoil::Mirrored, 0.0, 0.0),
        ] {
            let (dark, bright) = (drawn(spoil, 0.3), drawn(spoil, 0.7));
            let changed = |image: &RgbImage, v: f32| -> Vec<bool> {
                image.data.iter().map(|c| c.iter().any(|c| (c - v).abs() > 1e-4)).collect()
            };
            assert_eq!(changed(&dark, 0.3), changed(&bright, 0.7), "{spoil:?}");
            let share = changed(&dark, 0.3).iter().filter(|c| **c).count() as f64 / dark.data.len() as f64;
            assert!((least..=most).contains(&share), "{spoil:?} {share}");
        }
    }
}
