//! Colour maps of depth, relevancy and labels.
use crate::scene::{Image, RgbImage};

/// Turbo colour map (Mikhailov 2019) by its published polynomial fit, [0, 1] → sRGB.
pub fn turbo(v: f32) -> [f32; 3] {
    let x = if v.is_nan() { 0.0 } else { v.clamp(0.0, 1.0) };
    let polynomial = |c: [f32; 6]| c.iter().rev().fold(0.0, |sum, k| sum * x + k).clamp(0.0, 1.0);
    [
        polynomial([0.135_721_38, 4.615_392_6, -42.660_32, 132.131_08, -152.942_4, 59.286_38]),
        polynomial([0.091_402_61, 2.194_188_4, 4.842_966_6, -14.185_033, 4.277_298_6, 2.829_566]),
        polynomial([0.106_673_3, 12.641_946, -60.582_05, 110.362_77, -89.903_11, 27.348_25]),
    ]
}

/// Colour of a label, distinct from the colours of near indices: hues a golden angle apart;
/// negative labels are dark grey.
pub fn label(index: i32) -> [f32; 3] {
    if index < 0 {
        return [0.13; 3];
    }
    // 0.618… of a turn is the most even spacing for any count; saturation and value alternate to
    // widen the gaps.
    let hue = (index as f64 * 0.618_033_988_749_895).fract() as f32 * 6.0;
    let (saturation, value) = ([0.62, 0.85, 0.45][index as usize % 3], [0.95, 0.8][index as usize / 3 % 2]);
    let channel = |offset: f32| {
        let k = (offset + hue) % 6.0;
        value - value * saturation * k.min(4.0 - k).clamp(0.0, 1.0)
    };
    [channel(5.0), channel(3.0), channel(1.0)]
}

/// Colours of depth: near = warm, unknown (≤ 0) = black. The range is that of the central 98 %, so
/// that outliers do not flatten it.
pub fn depth_image(depth: &Image<f32>) -> RgbImage {
    let mut known: Vec<f32> = depth.data.iter().copied().filter(|z| *z > 0.0 && z.is_finite()).collect();
    known.sort_by(f32::total_cmp);
    let quantile =
        |q: f64| known.get(((known.len() as f64 - 1.0) * q).round() as usize).copied().unwrap_or(1.0);
    // Inverse depth, which image motion is proportional to.
    let (near, far) = (1.0 / quantile(0.01), 1.0 / quantile(0.99));
    let span = (near - far).max(1e-9);
    let colour =
        |z: f32| if z > 0.0 && z.is_finite() { turbo(0.05 + 0.9 * (1.0 / z - far) / span) } else { [0.0; 3] };
    map(depth, colour)
}

/// One colour per label.
pub fn label_image(labels: &Image<i32>) -> RgbImage {
    map(labels, label)
}

fn map<T: Copy>(plane: &Image<T>, colour: impl Fn(T) -> [f32; 3]) -> RgbImage {
    RgbImage {
        width: plane.width,
        height: plane.height,
        data: plane.data.iter().map(|v| colour(*v)).collect(),
    }
}

/// Relevancy over a picture of the same size: grey where it is low, warm where it is high; the mask
/// gets a white outline.
pub fn heat_image(picture: &RgbImage, relevancy: &Image<f32>, mask: Option<&Image<bool>>) -> RgbImage {
    let luma = picture.luma();
    let mut data = Vec::with_capacity(relevancy.data.len());
    for y in 0..relevancy.height {
        for x in 0..relevancy.width {
            // Relevancy 0.5 means "as close as a canonical phrase"; lower values show the plain
            // picture.
            let heat = ((relevancy.at(x, y) - 0.5) * 2.0).clamp(0.0, 1.0);
            let (base, hot) = (0.25 + 0.5 * luma.at(x, y), turbo(0.45 + 0.5 * heat));
            let share = 0.85 * heat;
            let colour = hot.map(|h| base * (1.0 - share) + h * share);
            data.push(if on_edge(mask, x, y) { [1.0; 3] } else { colour });
        }
    }
    RgbImage { width: relevancy.width, height: relevancy.height, data }
}

/// Whether a pixel is the outermost of a mask.
fn on_edge(mask: Option<&Image<bool>>, x: usize, y: usize) -> bool {
    mask.is_some_and(|m| {
        m.at(x, y)
            && (x == 0 || y == 0 || x + 1 == m.width || y + 1 == m.height || {
                let around = [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)];
                around.iter().any(|&(i, j)| !m.at(i, j))
            })
    })
}

/// A picture with a white outline around the mask; without colour and darker outside of it.
pub fn outline_image(picture: &RgbImage, mask: Option<&Image<bool>>) -> RgbImage {
    let luma = picture.luma();
    let colour = |i: usize| {
        let (x, y) = (i % picture.width, i / picture.width);
        match mask {
            _ if on_edge(mask, x, y) => [1.0; 3],
            Some(m) if m.at(x, y) => picture.data[i],
            _ => [0.25 + 0.5 * luma.at(x, y); 3],
        }
    };
    let data = (0..picture.data.len()).map(colour).collect();
    RgbImage { width: picture.width, height: picture.height, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turbo_matches_published_colours() {
        // Entries 0, 128 and 255 of the published table. Measured, the polynomial is within 0.02 of
        // it in the middle and up to 0.13 off at the two dark ends.
        for (v, e) in
            [(0.0, [0.19, 0.07, 0.23]), (128.0 / 255.0, [0.645, 0.99, 0.233]), (1.0, [0.48, 0.016, 0.011])]
        {
            let c = turbo(v);
            assert!((0..3).all(|k| (c[k] - e[k]).abs() < 0.14), "{v}: {c:?}");
        }
        assert_eq!(turbo(f32::NAN), turbo(0.0));
    }

    #[test]
    fn colours_of_near_labels_differ() {
        for i in 0..100 {
            for j in 1..8 {
                let (a, b) = (label(i), label(i + j));
                let far = (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>().sqrt();
                assert!(far > 0.1 && a.iter().all(|v| (0.0..=1.0).contains(v)), "{i} {j}: {far}");
            }
        }
    }

    #[test]
    fn depth_image_unknown_black_near_warm() {
        let d = Image { width: 3, height: 1, data: vec![0.0, 1.0, 4.0] };
        let c = depth_image(&d);
        assert_eq!(c.data[0], [0.0; 3]);
        assert!(c.data[1][0] > c.data[1][2] && c.data[2][2] > c.data[2][0]);
    }

    #[test]
    fn heat_image_outlines_the_mask() {
        let picture = RgbImage { width: 5, height: 5, data: vec![[0.2, 0.4, 0.6]; 25] };
        let mut relevancy = Image::filled(5, 5, 0.3);
        relevancy.data[12] = 0.95;
        let mut mask = Image::filled(5, 5, false);
        [6, 7, 8, 11, 12, 13, 16, 17, 18].iter().for_each(|&i| mask.data[i] = true);
        let out = heat_image(&picture, &relevancy, Some(&mask));
        assert_eq!(out.at(1, 1), [1.0; 3]);
        let (cold, hot) = (out.at(0, 0), out.at(2, 2));
        assert!(cold[0] == cold[2] && hot[0] > hot[2] + 0.3, "{cold:?} {hot:?}");
        let out = outline_image(&picture, Some(&mask));
        assert_eq!((out.at(1, 1), out.at(2, 2)), ([1.0; 3], [0.2, 0.4, 0.6]));
        assert_eq!(out.at(0, 0), outline_image(&picture, None).at(2, 2));
    }
}
