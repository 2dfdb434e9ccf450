//! White borders around photos (rectified or cropped images): nothing to match, nothing to fill.
use super::Level;
use super::surface::neighbours;

/// A channel at least this bright is saturated; JPEG leaves a few grey levels of ringing.
const WHITE: f32 = 0.95;
/// Frames are thin; a white wall that reaches further in is scene.
const DEEPEST_SHARE: f32 = 0.05;

/// Per pixel of all views: true for white that is connected to the image border within its outer 5 %.
pub fn white_border(level: &Level) -> Vec<bool> {
    let mut out = Vec::with_capacity(level.pixels());
    for guide in &level.guide {
        let (width, height) = (guide.width, guide.height);
        let deepest = (DEEPEST_SHARE * width.min(height) as f32).ceil() as usize;
        let rim =
            |k: usize| (k % width).min(width - 1 - k % width).min(k / width).min(height - 1 - k / width);
        let white = |k: usize| guide.data[k].iter().all(|&c| c >= WHITE);
        let mut void = vec![false; width * height];
        let mut stack: Vec<usize> = (0..width * height).filter(|&k| rim(k) == 0 && white(k)).collect();
        for &k in &stack {
            void[k] = true;
        }
        while let Some(k) = stack.pop() {
            for n in neighbours(k, width, height) {
                if !void[n] && white(n) && rim(n) < deepest {
                    void[n] = true;
                    stack.push(n);
                }
            }
        }
        out.extend(void);
    }
    out
}
