//! HED edge detection (Xie & Tu, ICCV 2015; BSDS500 weights).
use super::registry::{PackFileKind, Registry};
use super::runtime::{Input, Session};
use crate::scene::resize::Kernel;
use crate::scene::{Image, RgbImage};
use crate::{Error, Result};

/// Longer side of the network's largest input, pixels. Each of its first maps takes 256 bytes per
/// pixel: 490 MB at this size, 3 GB for a photo of 12 megapixels. Outlines of objects are as clear
/// in the smaller image.
const LARGEST_SIDE: usize = 1600;

/// The loaded network.
pub struct Hed {
    session: Session,
}

impl Hed {
    /// Loads the network of the model pack.
    pub fn load(registry: &Registry) -> Result<Self> {
        Ok(Hed { session: registry.session(PackFileKind::Edges)? })
    }

    /// Probability in [0, 1] that a person would draw a contour through each pixel.
    pub fn edges(&mut self, image: &RgbImage) -> Result<Image<f32>> {
        let (width, height) = (image.width, image.height);
        if width == 0 || height == 0 {
            return Err(Error::input("the image has no pixels"));
        }
        let long = width.max(height);
        if long > LARGEST_SIDE {
            let side = |n: usize| (n * LARGEST_SIDE / long).max(1);
            let small = self.edges(&image.resized_by_area(side(width), side(height)))?;
            let grey = RgbImage {
                width: small.width,
                height: small.height,
                data: small.data.iter().map(|v| [*v; 3]).collect(),
            };
            let data = grey.resized(width, height, Kernel::Triangle).data.iter().map(|c| c[0]).collect();
            return Ok(Image { width, height, data });
        }
        let input = Input::F32(vec![1, 3, height, width], planar(&image.data));
        let outputs = self.session.run(vec![("image", input)], &["edges"])?;
        let data = outputs.into_iter().next().map(|t| t.data).unwrap_or_default();
        Ok(Image { width, height, data })
    }
}

/// [H, W, 3] → [3, H, W].
pub(super) fn planar(pixels: &[[f32; 3]]) -> Vec<f32> {
    (0..3).flat_map(|c| pixels.iter().map(move |p| p[c])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatvk_test_support::breakfast::train_views;

    #[test]
    fn edges_follow_object_outlines() {
        let mut net = Hed::load(&Registry::open(None).unwrap()).unwrap();
        let view = &train_views()[0];
        let edges = net.edges(&view.image).unwrap();
        assert_eq!((edges.width, edges.height), (view.image.width, view.image.height));
        let (mut on, mut off) = (Vec::new(), Vec::new());
        let m = &view.masks;
        for y in 1..m.height - 1 {
            for x in 1..m.width - 1 {
                let outline = m.at(x, y) != m.at(x + 1, y) || m.at(x, y) != m.at(x, y + 1);
                if outline { &mut on } else { &mut off }.push(edges.at(x, y));
            }
        }
        let mean = |v: &[f32]| v.iter().sum::<f32>() / v.len() as f32;
        println!("mean edge probability {:.3} on outlines, {:.3} elsewhere", mean(&on), mean(&off));
        assert!(mean(&on) > 4.0 * mean(&off), "{} {}", mean(&on), mean(&off));
    }
}
