//! Boxes and crosses on pictures.
use splatvk::scene::{Image, RgbImage};

/// First and last column, first and last row.
pub(super) type Bounds = [usize; 4];

const WHITE: [f32; 3] = [1.0; 3];
const BLACK: [f32; 3] = [0.0; 3];
const GREEN: [f32; 3] = [0.1, 0.9, 0.2];
const RED: [f32; 3] = [1.0, 0.15, 0.1];
/// Half length of the arms of a cross, as a share of the width.
const ARM: f64 = 0.02;

/// Box of a mask; `None` for an empty one.
pub(super) fn bounds(mask: &Image<bool>) -> Option<Bounds> {
    let inside = || (0..mask.data.len()).filter(|&i| mask.data[i]);
    let columns = || inside().map(|i| i % mask.width);
    let rows = || inside().map(|i| i / mask.width);
    Some([columns().min()?, columns().max()?, rows().min()?, rows().max()?])
}

/// Draws the outline of a box, white within black.
pub(super) fn rectangle(image: &mut RgbImage, [left, right, top, bottom]: Bounds) {
    for (grow, colour) in [(1, BLACK), (0, WHITE)] {
        let (left, top) = (left.saturating_sub(grow), top.saturating_sub(grow));
        let (right, bottom) = ((right + grow).min(image.width - 1), (bottom + grow).min(image.height - 1));
        (left..=right).for_each(|x| [top, bottom].iter().for_each(|&y| put(image, x, y, colour)));
        (top..=bottom).for_each(|y| [left, right].iter().for_each(|&x| put(image, x, y, colour)));
    }
}

/// Draws a cross, green for a right location and red for a wrong one, on black.
pub(super) fn cross(image: &mut RgbImage, (x, y): (usize, usize), is_right: bool) {
    let arm = ((ARM * image.width as f64) as usize).max(3);
    let colour = if is_right { GREEN } else { RED };
    for (half, colour) in [(2, BLACK), (1, colour)] {
        let long = arm + half;
        for (wide, high) in [(long, half), (half, long)] {
            for row in y.saturating_sub(high)..=(y + high).min(image.height - 1) {
                for column in x.saturating_sub(wide)..=(x + wide).min(image.width - 1) {
                    put(image, column, row, colour);
                }
            }
        }
    }
}

fn put(image: &mut RgbImage, x: usize, y: usize, colour: [f32; 3]) {
    image.data[y * image.width + x] = colour;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_stay_inside_and_in_place() {
        let mut mask = Image::filled(20, 10, false);
        assert_eq!(bounds(&mask), None);
        for (x, y) in [(0, 9), (7, 4), (3, 6)] {
            mask.data[y * 20 + x] = true;
        }
        assert_eq!(bounds(&mask), Some([0, 7, 4, 9]));
        let mut image = RgbImage { width: 20, height: 10, data: vec![[0.5; 3]; 200] };
        rectangle(&mut image, [0, 7, 4, 9]);
        assert_eq!(
            (image.data[4 * 20], image.data[9 * 20 + 7], image.data[6 * 20 + 3]),
            (WHITE, WHITE, [0.5; 3])
        );
        cross(&mut image, (19, 0), false);
        assert_eq!((image.data[19], image.data[4 * 20 + 19], image.data[3 * 20 + 15]), (RED, RED, [0.5; 3]));
    }
}
