//! Labels of the published layouts as one object index per pixel: ground truth for masks and
//! features.
use splatvk::eval::ObjectMaps;
use splatvk::scene::{Camera, Image};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Labels of a folder in a published layout.
#[derive(Clone, Debug)]
pub struct Labels {
    /// Labelled frames in order, by file stem.
    pub stems: Vec<String>,
    /// Object index, from 1, → phrase; 0 is no object.
    pub phrases: BTreeMap<u32, String>,
    /// Object index per pixel of each frame.
    pub maps: Arc<dyn ObjectMaps>,
    /// Cameras of the layout itself.
    pub cameras: Vec<Camera>,
}

/// Numbers phrases from 1 in their order.
pub(super) fn numbered(phrases: impl IntoIterator<Item = String>) -> BTreeMap<u32, String> {
    (1..).zip(phrases).collect()
}

/// Paints the masks of one frame into one image of object indices: of overlapping objects the
/// smaller one is in front.
pub(super) fn paint(mut masks: Vec<(u32, Image<bool>)>) -> Option<Image<u32>> {
    masks.sort_by_key(|(_, m)| std::cmp::Reverse(m.data.iter().filter(|&&inside| inside).count()));
    let (_, first) = masks.first()?;
    let mut out = Image::filled(first.width, first.height, 0u32);
    let pixels = out.data.len();
    for (label, mask) in masks.iter().filter(|(_, m)| m.data.len() == pixels) {
        let inside = out.data.iter_mut().zip(&mask.data).filter(|(_, inside)| **inside);
        inside.for_each(|(slot, _)| *slot = *label);
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paint_puts_smaller_masks_in_front() {
        let mask = |from: usize, to: usize| Image {
            width: 6,
            height: 1,
            data: (0..6).map(|x| (from..to).contains(&x)).collect(),
        };
        let plane = paint(vec![(7, mask(2, 4)), (3, mask(0, 5))]).unwrap();
        assert_eq!(plane.data, [3, 3, 7, 7, 3, 0]);
        assert!(paint(Vec::new()).is_none());
    }
}
