//! Restriction of a pixel's short codes to those that its splats carry
//! (docs/internals/method.md#short-codes-at-borders).
use crate::gpu::Device;
use crate::pass::renderer::Renderer;
use crate::query::instances::splat_codes;
use crate::scene::{Camera, Image, LevelField, Splats};
use crate::{Error, Result};
use rayon::prelude::*;

/// Longest code that needs the rule: with length 3 a mix of two codes is nearest to a third at
/// almost every border, with 8 hardly ever (docs/internals/method.md#code-length).
const SHORT: usize = 4;
/// Codebooks with more codes do not hold the things of a scene but a table of directions (an
/// autoencoder's), whose neighbours mean the same.
const MOST_CODES: usize = 512;
/// Minimum blending weight of a code's splats in a pixel that decodes to it. A solid thing has a
/// weight of 1; the faintest of three things in one pixel is below this bound or really visible.
const LEAST_WEIGHT: f32 = 0.1;
/// Codes whose weights are rendered at once: as many as features of the usual length, which every
/// device binds.
const AT_ONCE: usize = 16;

/// Renders the blending weight of every code's splats per pixel.
pub(super) struct Border {
    renderer: Renderer,
    /// Code of each splat.
    codes: Vec<Option<usize>>,
    /// Codes that some splat carries, ascending.
    carried: Vec<usize>,
    /// Codebook, [K, d].
    book: Vec<f32>,
    d: usize,
}

impl Border {
    /// Prepares the rule for a level whose features `splats` carry; `None` if its codes do not need
    /// it.
    pub fn new(device: &Device, splats: &Splats, level: &LevelField) -> Result<Option<Border>> {
        let (d, book) = (level.codebook.code_dim, &level.codebook);
        if d == 0
            || d > SHORT
            || book.codes.len() > MOST_CODES * d
            || level.features.len() != splats.len() * d
        {
            return Ok(None);
        }
        let codes = splat_codes(level);
        let mut carried: Vec<usize> = codes.iter().flatten().copied().collect();
        carried.sort_unstable();
        carried.dedup();
        let renderer = Renderer::new(device, splats, &vec![0.0; AT_ONCE * splats.len()], AT_ONCE)?;
        Ok(Some(Border { renderer, codes, carried, book: book.codes.clone(), d }))
    }

    /// Decodes every pixel that has a code again, to the nearest of the codes that its splats
    /// carry. `features` are the blended ones, [H, W, d].
    pub fn decode_again(&mut self, camera: &Camera, features: &[f32], codes: &mut Image<i32>) -> Result<()> {
        let d = self.d;
        if features.len() != codes.data.len() * d {
            return Err(Error::work("features of another frame"));
        }
        let mut best = vec![f32::NEG_INFINITY; codes.data.len()];
        for chunk in self.carried.chunks(AT_ONCE) {
            let mut one_hot = vec![0f32; AT_ONCE * self.codes.len()];
            for (row, code) in one_hot.chunks_exact_mut(AT_ONCE).zip(&self.codes) {
                if let Some(k) = code.and_then(|code| chunk.iter().position(|c| *c == code)) {
                    row[k] = 1.0;
                }
            }
            self.renderer.set_features(&one_hot)?;
            let weights = self.renderer.render(camera)?.features;
            let pixels = codes.data.par_iter_mut().zip(&mut best).zip(weights.par_chunks_exact(AT_ONCE));
            pixels.zip(features.par_chunks_exact(d)).for_each(|(((code, best), weights), feature)| {
                if *code < 0 {
                    return;
                }
                for (&k, _) in chunk.iter().zip(weights).filter(|(_, w)| **w >= LEAST_WEIGHT) {
                    let dot = feature.iter().zip(&self.book[k * d..]).map(|(a, b)| a * b).sum::<f32>();
                    if dot > *best {
                        (*best, *code) = (dot, k as i32);
                    }
                }
            });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::view::Viewer;
    use super::*;
    use crate::scene::seeded;
    use crate::scene::{Codebook, LanguageField};

    #[test]
    fn border_of_two_shows_no_third() {
        let device = crate::gpu::open(None).unwrap();
        let (mut splats, camera) = seeded::small(600, 96, 72, 0, 1003);
        splats.opacity_logits.fill(1.0);
        // The third code lies between the others, and no splat carries it.
        let codes = vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.5f32.sqrt(), 0.5f32.sqrt(), 0.0];
        let book = Codebook {
            embedding_dim: 1,
            code_dim: 3,
            embeddings: vec![1.0; 3],
            codes,
            ..Codebook::default()
        };
        let middle =
            crate::math::median(&mut splats.means.iter().map(|p| f64::from(p[0])).collect::<Vec<_>>())
                .unwrap();
        let right = |p: &[f32; 3]| usize::from(f64::from(p[0]) > middle);
        let features: Vec<f32> =
            splats.means.iter().flat_map(|p| [0, 1, 2].map(|k| f32::from(u8::from(k == right(p))))).collect();
        let level = LevelField { codebook: book.clone(), features, ..LevelField::default() };
        let field = LanguageField { levels: vec![level], space: "test".into() };
        let mut viewer = Viewer::new(&device, &splats, &field).unwrap();
        let frame = viewer.view_with_features(&camera).unwrap();
        let nearest = frame.rendered.features.chunks_exact(3).map(|f| book.decode(f));
        let ghosts =
            nearest.zip(&frame.codes[0].data).filter(|(k, code)| **code >= 0 && *k == Some(2)).count();
        let shown = |k: i32| frame.codes[0].data.iter().filter(|c| **c == k).count();
        println!(
            "{ghosts} pixels are nearest to the third code; decoded {} {} {}",
            shown(0),
            shown(1),
            shown(2)
        );
        assert!(ghosts > 100, "a case for the rule");
        assert_eq!(shown(2), 0);
        assert!(shown(0) > 500 && shown(1) > 500);
        assert_eq!(viewer.codes(&camera).unwrap(), frame.codes);
    }
}
