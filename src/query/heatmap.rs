//! Relevancy as a picture.
use crate::scene::{Plane, RgbImage};

/// Share of the heat colour over the photo at full relevancy; less hides the colour, more hides the photo.
const OPACITY: f32 = 0.75;

/// The relevancy over the photo (or render) of the same size. Relevancy 0.5 (no closer than a canonical phrase) leaves
/// the photo as it is, dimmed; 1 is dark red.
pub fn heat_map(image: &RgbImage, relevancy: &Plane<f32>) -> RgbImage {
    let data = image.data.iter().zip(&relevancy.data).map(|(c, &r)| {
        let heat = ((r - 0.5) * 2.0).clamp(0.0, 1.0);
        let share = OPACITY * (heat * 2.0).min(1.0);
        let colour = turbo(0.15 + 0.85 * heat);
        std::array::from_fn(|k| (1.0 - share) * 0.7 * c[k] + share * colour[k])
    });
    RgbImage { width: image.width, height: image.height, data: data.collect() }
}

/// Google's Turbo colour map, polynomial approximation (Mikhailov 2019, published coefficients).
pub fn turbo(x: f32) -> [f32; 3] {
    let x = x.clamp(0.0, 1.0);
    let (x2, x3) = (x * x, x * x * x);
    let (x4, x5) = (x2 * x2, x2 * x3);
    let poly =
        |k: [f32; 6]| (k[0] + k[1] * x + k[2] * x2 + k[3] * x3 + k[4] * x4 + k[5] * x5).clamp(0.0, 1.0);
    [
        poly([0.135_721_38, 4.615_392_6, -42.660_322, 132.131_08, -152.942_4, 59.286_38]),
        poly([0.091_402_61, 2.194_188_4, 4.842_966_6, -14.185_033, 4.277_298_6, 2.829_566]),
        poly([0.106_673_3, 12.641_946, -60.582_05, 110.362_77, -89.903_11, 27.348_25]),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colour_runs_from_blue_to_red_and_nothing_leaves_the_photo() {
        let (low, high) = (turbo(0.15), turbo(0.9));
        assert!(low[2] > low[0] && high[0] > 2.0 * high[2]);
        let image = RgbImage { width: 2, height: 1, data: vec![[0.2, 0.4, 0.6]; 2] };
        let out = heat_map(&image, &Plane { width: 2, height: 1, data: vec![0.5, 1.0] });
        for k in 0..3 {
            assert!((out.data[0][k] - 0.7 * image.data[0][k]).abs() < 1e-6);
        }
        assert!(out.data[1][0] > out.data[1][2]);
    }
}
