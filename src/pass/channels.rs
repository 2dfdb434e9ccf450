//! Blocks of channels, one per dispatch of the raster kernels.
use crate::gpu::shaders;

/// Number of channels before the d features in every stack of planes: RGB and depth.
pub const BASE_CHANNELS: usize = shaders::shared::layout::BASE_CHANNELS as usize;

/// Block of channels of one dispatch of the raster kernels. Their cost per pixel and splat has a
/// fixed part, but their registers grow with the channels, so 48 features take three dispatches of
/// 16.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Block {
    /// The kernel variant: 4, 7, 12, 20 with RGB and depth, 16 without.
    pub channels: u32,
    /// First vector of four in a splat's code.
    pub first_vector: u32,
    /// First plane of the block.
    pub first_plane: u32,
    /// Features in this block; the variant may have room for more.
    pub features: u32,
}

impl Block {
    /// Vectors of four features that the variant has room for.
    pub(super) fn vectors(&self) -> u32 {
        let base = if self.channels == 16 { 0 } else { BASE_CHANNELS as u32 };
        (self.channels - base).div_ceil(4)
    }
}

/// Most features of one dispatch.
const BLOCK_FEATURES: u32 = 16;

/// Splits d features into dispatches; the first also has RGB and depth.
pub(super) fn blocks(dim: u32) -> Vec<Block> {
    let features = dim.min(BLOCK_FEATURES);
    let channels = match features {
        0 => BASE_CHANNELS as u32,
        1..=3 => 7,
        4..=8 => 12,
        _ => 20,
    };
    let mut blocks = vec![Block { channels, first_vector: 0, first_plane: 0, features }];
    let mut done = features;
    while done < dim {
        blocks.push(Block {
            channels: 16,
            first_vector: done / 4,
            first_plane: BASE_CHANNELS as u32 + done,
            features: (dim - done).min(BLOCK_FEATURES),
        });
        done += BLOCK_FEATURES;
    }
    blocks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_cover_every_feature_once() {
        for dim in [0, 1, 3, 5, 8, 16, 17, 48, 50] {
            let blocks = blocks(dim);
            assert_eq!(blocks.iter().map(|b| b.features).sum::<u32>(), dim);
            let mut next = 0;
            for (k, block) in blocks.iter().enumerate() {
                let base = if k == 0 { BASE_CHANNELS as u32 } else { 0 };
                assert!(block.features + base <= block.channels);
                assert_eq!(block.first_vector * 4, next);
                assert_eq!(block.first_plane + base, BASE_CHANNELS as u32 + next);
                next += block.features;
            }
        }
    }
}
