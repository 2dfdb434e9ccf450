//! Orientation of the stored pixels of a file.
use image::metadata::Orientation;
use serde::{Deserialize, Serialize};

/// EXIF orientation of a file: its stored pixels are rotated, then mirrored, to be upright.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Turn {
    /// Quarter turns clockwise, 0 to 3.
    pub quarters: u8,
    /// Whether the rotated pixels are mirrored horizontally.
    pub mirrored: bool,
}

impl From<Orientation> for Turn {
    fn from(orientation: Orientation) -> Turn {
        let (quarters, mirrored) = match orientation {
            Orientation::NoTransforms => (0, false),
            Orientation::FlipHorizontal => (0, true),
            Orientation::Rotate180 => (2, false),
            Orientation::FlipVertical => (2, true),
            Orientation::Rotate90FlipH => (1, true),
            Orientation::Rotate90 => (1, false),
            Orientation::Rotate270FlipH => (3, true),
            Orientation::Rotate270 => (3, false),
        };
        Turn { quarters, mirrored }
    }
}

impl Turn {
    /// Whether the stored pixels are upright.
    pub fn is_none(self) -> bool {
        self == Turn::default()
    }

    /// (width, height) of the stored picture for an upright one of `size`.
    pub fn stored(self, (w, h): (u32, u32)) -> (u32, u32) {
        if self.quarters % 2 == 1 { (h, w) } else { (w, h) }
    }

    /// Value of the EXIF tag, 1 to 8.
    pub fn exif(self) -> u8 {
        match (self.quarters % 4, self.mirrored) {
            (0, false) => 1,
            (0, true) => 2,
            (2, false) => 3,
            (2, true) => 4,
            (1, true) => 5,
            (1, false) => 6,
            (_, true) => 7,
            (_, false) => 8,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_are_those_of_the_tags() {
        for tag in 1..=8u8 {
            let turn = Turn::from(Orientation::from_exif(tag).unwrap());
            assert_eq!((turn.exif(), turn.stored((4, 3)) == (3, 4)), (tag, tag > 4));
            // The stored picture, rotated and mirrored as the type states, equals the tag's
            // definition.
            let stored = image::RgbImage::from_fn(3, 2, |x, y| image::Rgb([x as u8, y as u8, 0]));
            let mut upright = image::DynamicImage::from(stored.clone());
            upright.apply_orientation(Orientation::from_exif(tag).unwrap());
            let turned = (0..turn.quarters).fold(stored, |image, _| image::imageops::rotate90(&image));
            let made = if turn.mirrored { image::imageops::flip_horizontal(&turned) } else { turned };
            assert_eq!(upright.to_rgb8(), made, "tag {tag}");
        }
    }
}
