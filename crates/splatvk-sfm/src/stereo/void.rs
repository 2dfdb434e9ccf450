//! Void pixels, which are neither matched nor filled: white borders (rectified or cropped images)
//! and unused pixels.
use super::Level;
use super::surface::neighbours;
use crate::scene::Coverage;

/// Least value of a saturated channel; JPEG leaves a few grey levels of ringing.
const WHITE: f32 = 0.95;
/// Widest border as a share of the shorter side; a white wall that reaches further in is scene.
const DEEPEST_SHARE: f32 = 0.05;

/// [`white_border`] and the unused pixels of `coverage`, which has an entry per view or none.
pub fn unused(level: &Level, coverage: &[Option<Coverage>]) -> Vec<bool> {
    let mut out = white_border(level);
    for (view, coverage) in coverage.iter().enumerate() {
        let (Some(coverage), Some(r)) = (coverage, level.references.get(view)) else { continue };
        let (width, height) = (r.width as usize, r.height as usize);
        // As in `depth_map`: the level may have half the photo's size, or less.
        let scale = (coverage.share.width / width).max(1);
        for k in 0..width * height {
            let (x, y) = (k % width * scale + scale / 2, k / width * scale + scale / 2);
            let (x, y) = (x.min(coverage.share.width - 1), y.min(coverage.share.height - 1));
            out[r.first as usize + k] |= !coverage.uses(y * coverage.share.width + x);
        }
    }
    out
}

/// Per pixel of all views: true for white connected to the image border within its outer 5 %.
pub fn white_border(level: &Level) -> Vec<bool> {
    let mut out = Vec::with_capacity(level.pixels());
    for guide in &level.guide {
        let (width, height) = (guide.width, guide.height);
        let deepest = (DEEPEST_SHARE * width.min(height) as f32).ceil() as usize;
        let border_distance =
            |k: usize| (k % width).min(width - 1 - k % width).min(k / width).min(height - 1 - k / width);
        let is_white = |k: usize| guide.data[k].iter().all(|&c| c >= WHITE);
        let mut void = vec![false; width * height];
        let mut stack: Vec<usize> =
            (0..width * height).filter(|&k| border_distance(k) == 0 && is_white(k)).collect();
        for &k in &stack {
            void[k] = true;
        }
        while let Some(k) = stack.pop() {
            for n in neighbours(k, width, height) {
                if !void[n] && is_white(n) && border_distance(n) < deepest {
                    void[n] = true;
                    stack.push(n);
                }
            }
        }
        out.extend(void);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Image, Outside, RgbImage};
    use crate::stereo::ReferenceView;

    #[test]
    fn unused_pixels_are_void() {
        // Two views of 6 × 4 pixels; the second photo has twice the size and an unused left third.
        let view = |first| ReferenceView { first, width: 6, height: 4, ..ReferenceView::default() };
        let grey = RgbImage { width: 6, height: 4, data: vec![[0.5; 3]; 24] };
        let level = Level {
            references: vec![view(0), view(24)],
            guide: vec![grey.clone(), grey],
            cameras: Vec::new(),
            luma: Vec::new(),
            sources: Vec::new(),
            tolerance: Vec::new(),
            compared: Vec::new(),
        };
        let share = (0..12 * 8).map(|i| if i % 12 < 4 { 0.0 } else { 1.0 }).collect();
        let coverage =
            Coverage { share: Image { width: 12, height: 8, data: share }, outside: Outside::Empty };
        let void = unused(&level, &[None, Some(coverage)]);
        let expected: Vec<bool> = (0..48).map(|k| k >= 24 && k % 6 < 2).collect();
        assert_eq!(void, expected);
    }
}
