//! Bands of rows, for images larger than a device binds at once.
//!
//! The planes of an image exceed a binding first: 4 bytes per pixel and channel, 52 channels with
//! three levels of 16 features. A band has its own planes, targets and labels; splats are projected
//! and sorted once for all bands, and the gradients of all bands add up in the same buffers. Bands
//! overlap by 16 rows on either side, which are rendered for the windows of SSIM and have no loss
//! of their own. An image that fits is one band.
use crate::gpu::DeviceInfo;
use crate::{Error, Result};
use std::ops::Range;

/// Rows on either side of a band that belong to its neighbours: the gradient of SSIM reaches twice
/// five rows, and whole tiles and strips of 16 rows keep every sum in the order of a whole image.
const HALO: usize = 16;
/// Fewest inner rows of a band; smaller bands render mostly halo.
const FEWEST_ROWS: usize = 16;
/// Bytes per pixel of the widest buffer of SSIM, vec2 for three colours.
const SSIM_BYTES: u64 = 24;
/// Threads of the passes that have one thread per pixel of a band in a one-dimensional dispatch.
const THREADS: u64 = 64;

/// Rows that one set of planes holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Band {
    /// Position among the bands.
    pub index: usize,
    /// First row of the image that is stored.
    pub top: usize,
    /// Number of stored rows, equal in all bands.
    pub rows: usize,
    /// Inner rows: the rows of the image with a loss in this band. Those of all bands make up the
    /// image.
    pub inner: Range<usize>,
}

/// Division of an image into bands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Bands {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Rows stored at once.
    pub rows: usize,
    tops: Vec<usize>,
}

/// Bytes per pixel of the largest buffer that an image with `planes` channels needs.
fn pixel_bytes(planes: usize) -> u64 {
    // The gradients have one plane more, by alpha.
    (4 * (planes as u64 + 1)).max(SSIM_BYTES)
}

/// Most pixels with `planes` channels that the device holds at once.
fn most_pixels(device: &DeviceInfo, planes: usize) -> usize {
    let bound = device.max_storage_range / pixel_bytes(planes);
    bound.min(u64::from(device.max_groups[0]) * THREADS) as usize
}

/// Width of the widest image with `planes` channels that the device renders in bands, pixels.
pub fn widest(device: &DeviceInfo, planes: usize) -> usize {
    // `Bands::new` may need up to 15 rows more.
    most_pixels(device, planes) / (2 * HALO + FEWEST_ROWS + 15)
}

impl Bands {
    /// The whole image at once.
    pub fn whole(width: usize, height: usize) -> Bands {
        Bands { width, height, rows: height, tops: vec![0] }
    }

    /// Divides an image with `planes` channels into as few bands as the device allows.
    ///
    /// # Errors
    /// Where the image is wider than [`widest`].
    pub fn new(device: &DeviceInfo, width: usize, height: usize, planes: usize) -> Result<Bands> {
        let fit = most_pixels(device, planes) / width.max(1);
        if height <= fit {
            return Ok(Bands::whole(width, height));
        }
        // Every band is aligned to 16 rows and stores equally many, so that a plane begins at the
        // same offset in all of them: the stored rows leave the same remainder as the height.
        let rows = fit.saturating_sub(height % 16) / 16 * 16 + height % 16;
        if rows < 2 * HALO + FEWEST_ROWS || width > widest(device, planes) {
            return Err(Error::gpu(format!(
                "an image {width} pixels wide with {planes} channels: {} binds at most {} MiB, enough for a width of {}",
                device.name,
                device.max_storage_range >> 20,
                widest(device, planes)
            )));
        }
        let step = (rows - 2 * HALO) / 16 * 16;
        let last = height - rows;
        let tops = (0..).map(|k| k * step).take_while(|&top| top < last).chain([last]).collect();
        Ok(Bands { width, height, rows, tops })
    }

    /// Number of bands.
    pub fn count(&self) -> usize {
        self.tops.len()
    }

    /// Band by index.
    pub fn get(&self, index: usize) -> Band {
        let top = self.tops[index];
        let begin = if index == 0 { 0 } else { top + HALO };
        let end = self.tops.get(index + 1).map_or(self.height, |next| next + HALO);
        Band { index, top, rows: self.rows, inner: begin..end }
    }

    /// All bands, from top to bottom.
    pub fn iter(&self) -> impl Iterator<Item = Band> + '_ {
        (0..self.count()).map(|k| self.get(k))
    }

    /// Pixels stored at once.
    pub fn pixels(&self) -> usize {
        self.width * self.rows
    }

    /// Stored rows of a band cut out of `planes` [C, H, W].
    pub fn cut<T: Copy>(&self, band: &Band, planes: &[T]) -> Vec<T> {
        let rows = band.top * self.width..(band.top + band.rows) * self.width;
        planes
            .chunks_exact((self.width * self.height).max(1))
            .flat_map(|p| &p[rows.clone()])
            .copied()
            .collect()
    }

    /// [`Bands::cut`] with `void` in the halo rows.
    pub fn cut_inner<T: Copy>(&self, band: &Band, planes: &[T], void: T) -> Vec<T> {
        let mut out = self.cut(band, planes);
        for plane in out.chunks_exact_mut(self.pixels().max(1)) {
            plane[..(band.inner.start - band.top) * self.width].fill(void);
            plane[(band.inner.end - band.top) * self.width..].fill(void);
        }
        out
    }

    /// Inner pixels of a band, as a range of the image.
    pub fn inner(&self, band: &Band) -> Range<usize> {
        band.inner.start * self.width..band.inner.end * self.width
    }

    /// Inner pixels of a band, as a range of the stored pixels.
    pub fn stored(&self, band: &Band) -> Range<usize> {
        (band.inner.start - band.top) * self.width..(band.inner.end - band.top) * self.width
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::test_device;

    #[test]
    fn bands_cover_the_image_once() {
        let mut info = test_device().info().clone();
        for mib in [16, 64, 128] {
            info.max_storage_range = mib << 20;
            for (width, height) in [(640, 480), (640, 487), (800, 600), (33, 3000), (1200, 8000), (1000, 120)]
            {
                for planes in [4, 20, 52] {
                    let bands = Bands::new(&info, width, height, planes).unwrap();
                    let bytes = pixel_bytes(planes) * bands.pixels() as u64;
                    assert!(bytes <= info.max_storage_range, "{mib} {width} × {height} × {planes}");
                    let mut next = 0;
                    for band in bands.iter() {
                        assert!(
                            band.inner.start == next && band.top % 16 == 0 && band.top + band.rows <= height
                        );
                        assert!(band.index == 0 || band.inner.start - band.top >= HALO);
                        let below = band.top + band.rows - band.inner.end;
                        assert!(band.index + 1 == bands.count() || below >= HALO, "{band:?}");
                        next = band.inner.end;
                    }
                    assert_eq!(next, height);
                    assert_eq!(
                        bands.count() == 1,
                        (width * height) as u64 * pixel_bytes(planes) <= mib << 20
                    );
                }
            }
        }
        info.max_storage_range = 8 << 20;
        let wide = widest(&info, 52);
        assert!(Bands::new(&info, wide, 10_000, 52).is_ok());
        assert!(Bands::new(&info, wide + 1, 10_000, 52).unwrap_err().to_string().contains("pixels wide"));
    }

    #[test]
    fn cut_returns_the_stored_rows() {
        let bands = Bands { width: 2, height: 96, rows: 64, tops: vec![0, 32] };
        let planes: Vec<u32> = (0..2 * 2 * 96).collect();
        let band = bands.get(1);
        assert_eq!(band.inner, 48..96);
        let cut = bands.cut(&band, &planes);
        assert_eq!((cut.len(), cut[0], cut[128]), (256, 64, 192 + 64));
        let inner = bands.cut_inner(&band, &planes, 9999);
        assert!(inner[..32].iter().all(|v| *v == 9999) && inner[32] == 96);
        assert_eq!(cut[bands.stored(&band)], planes[bands.inner(&band)]);
    }
}
