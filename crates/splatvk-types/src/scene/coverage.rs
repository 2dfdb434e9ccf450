//! Coverage: the used pixels of a photo.
use super::image::{Image, RgbImage};
use serde::{Deserialize, Serialize};

/// Meaning of the pixels of a photo that are not used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outside {
    /// Unknown content, as under a mask. No loss counts them.
    Unknown,
    /// A transparent background. Renders become transparent there.
    Empty,
}

/// The used pixels of a photo, and the meaning of the others.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Coverage {
    /// [H, W] used share of every working pixel, in [0, 1].
    pub share: Image<f32>,
    /// Meaning of the other pixels.
    pub outside: Outside,
}

impl Coverage {
    /// Whether a pixel counts for matches, depth and masks: at least half of it is used.
    pub fn uses(&self, index: usize) -> bool {
        self.share.data[index] >= 0.5
    }

    /// [H, W] weight of every pixel in losses: 0 or 1. Empty pixels count fully, as their colour is
    /// known; of unknown content even a part of a pixel would distort the loss.
    pub fn weights(&self) -> Image<f32> {
        let weight = |share: &f32| match self.outside {
            Outside::Empty => 1.0,
            // Averaging leaves a little less than 1 where everything is used.
            Outside::Unknown => f32::from(u8::from(*share > 0.999)),
        };
        Image { data: self.share.data.iter().map(weight).collect(), ..self.share.clone() }
    }

    /// Coverage, or all pixels, without the pixels where something hides the scene; the scene
    /// behind them is unknown.
    pub fn without(before: Option<&Coverage>, hidden: &Image<bool>) -> Coverage {
        let remaining = |(i, hidden): (usize, &bool)| match before {
            _ if *hidden => 0.0,
            Some(before) => before.share.data[i],
            None => 1.0,
        };
        let data = hidden.data.iter().enumerate().map(remaining).collect();
        let share = Image { width: hidden.width, height: hidden.height, data };
        Coverage { share, outside: Outside::Unknown }
    }

    /// Target of a render: black where nothing is there.
    pub fn target(&self, image: &RgbImage) -> RgbImage {
        match self.outside {
            Outside::Unknown => image.clone(),
            Outside::Empty => {
                let data = image.data.iter().zip(&self.share.data).map(|(c, a)| c.map(|v| v * a)).collect();
                RgbImage { data, ..image.clone() }
            }
        }
    }
}

impl RgbImage {
    /// Fills unused pixels with colours that continue the used ones smoothly, so that neither
    /// filters nor features see an edge: means over larger and larger blocks (pull-push, Gortler et
    /// al. 1996). Without any used pixel nothing changes.
    pub fn fill_from_used(&mut self, used: impl Fn(usize) -> bool) {
        let weights: Vec<bool> = (0..self.width * self.height).map(used).collect();
        if weights.contains(&true) {
            fill(self, &weights);
        }
    }
}

fn fill(image: &mut RgbImage, known: &[bool]) {
    if !known.contains(&false) {
        return;
    }
    let (w, h) = (image.width.div_ceil(2), image.height.div_ceil(2));
    let mut half = RgbImage { width: w, height: h, data: vec![[0.0; 3]; w * h] };
    let mut counts = vec![0u32; w * h];
    for i in (0..image.data.len()).filter(|i| known[*i]) {
        let block = i / image.width / 2 * w + i % image.width / 2;
        counts[block] += 1;
        (0..3).for_each(|c| half.data[block][c] += image.data[i][c]);
    }
    for (colour, count) in half.data.iter_mut().zip(&counts) {
        *colour = colour.map(|v| v / (*count).max(1) as f32);
    }
    fill(&mut half, &counts.iter().map(|c| *c > 0).collect::<Vec<_>>());
    for i in (0..image.data.len()).filter(|i| !known[*i]) {
        let position = |v: usize| 0.5 * v as f32 - 0.25;
        image.data[i] = half.bilinear(position(i % image.width), position(i / image.width));
    }
}

impl RgbImage {
    /// Bilinear interpolation of the colour; whole numbers are pixel centres.
    fn bilinear(&self, x: f32, y: f32) -> [f32; 3] {
        let ((x0, x1, u), (y0, y1, v)) = (neighbours(x, self.width), neighbours(y, self.height));
        mix(mix(self.at(x0, y0), self.at(x1, y0), u), mix(self.at(x0, y1), self.at(x1, y1), u), v)
    }
}

/// The two pixels around a position along an axis, and the weight of the second.
fn neighbours(v: f32, size: usize) -> (usize, usize, f32) {
    let v = v.clamp(0.0, (size - 1) as f32);
    (v as usize, (v as usize + 1).min(size - 1), v.fract())
}

/// Linear interpolation of colours.
fn mix(a: [f32; 3], b: [f32; 3], t: f32) -> [f32; 3] {
    [0, 1, 2].map(|c| a[c] + t * (b[c] - a[c]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn coverage(outside: Outside) -> Coverage {
        Coverage { share: Image { width: 3, height: 1, data: vec![0.0, 0.5, 1.0] }, outside }
    }

    #[test]
    fn emptiness_counts_and_unknown_does_not() {
        let image = RgbImage { width: 3, height: 1, data: vec![[0.8; 3]; 3] };
        let (unknown, empty) = (coverage(Outside::Unknown), coverage(Outside::Empty));
        assert_eq!((unknown.weights().data, unknown.target(&image)), (vec![0.0, 0.0, 1.0], image.clone()));
        assert_eq!(empty.weights().data, [1.0; 3]);
        assert_eq!(empty.target(&image).data, [[0.0; 3], [0.4; 3], [0.8; 3]]);
        assert_eq!([0, 1, 2].map(|i| empty.uses(i)), [false, true, true]);
    }

    #[test]
    fn unused_pixels_go_on_smoothly() {
        let (w, h) = (40, 30);
        let data = (0..w * h).map(|i| [if i % w < 20 { 0.2 } else { 0.8 }; 3]).collect();
        let before = RgbImage { width: w, height: h, data };
        let mut image = before.clone();
        // Known on the left and on the right.
        let used = |i: usize| !(8..32).contains(&(i % w));
        image.data.iter_mut().enumerate().filter(|(i, _)| !used(*i)).for_each(|(_, c)| *c = [9.0; 3]);
        image.fill_from_used(used);
        let row: Vec<f32> = (0..w).map(|x| image.at(x, 15)[0]).collect();
        assert!((0..w).filter(|x| used(*x)).all(|x| row[x] == before.at(x, 15)[0]));
        // Each end is closer to the colour of its own side: 0.22 and 0.59 here.
        assert!(row[9] < 0.35 && row[30] > 0.5, "{row:?}");
        assert!(row.windows(2).all(|p| p[1] >= p[0] - 1e-6 && p[1] - p[0] < 0.16), "no edge: {row:?}");
        let untouched = image.clone();
        image.fill_from_used(|_| false);
        assert_eq!(image, untouched);
    }
}
