//! Packing of rendered planes into texels for host programs.
use super::bands::Band;
use super::channels::BASE_CHANNELS;
use super::frame::FrameBuffers;
use crate::gpu::{Buffer, Device, Recorder, shaders};
use crate::{Error, Result};

/// Channels of a frame to pack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameChannel {
    /// R, G, B on the background and alpha; only [`Encoding::Unorm8x4`] clamps to [0, 1].
    Colour,
    /// Accumulated opacity.
    Alpha,
    /// Expected camera z, world units; 0 where alpha < ½.
    Depth,
    /// Blended features: (first, count) of the frame's feature channels.
    Features(usize, usize),
}

/// Storage of texels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// 32-bit floats, all channels of a pixel side by side: `[H, W, C]`.
    F32,
    /// 32-bit floats in groups of four, the last one filled up with zeros: `[⌈C/4⌉, H, W, 4]`,
    /// layers of an RGBA image.
    F32x4,
    /// 16-bit floats in groups of four.
    F16x4,
    /// 8-bit unorm in groups of four.
    Unorm8x4,
}

impl FrameChannel {
    fn index(self) -> u32 {
        match self {
            FrameChannel::Colour => 0,
            FrameChannel::Alpha => 1,
            FrameChannel::Depth => 2,
            FrameChannel::Features(..) => 3,
        }
    }
    /// Values per pixel.
    pub fn channels(self) -> usize {
        match self {
            FrameChannel::Colour => 4,
            FrameChannel::Alpha | FrameChannel::Depth => 1,
            FrameChannel::Features(_, count) => count,
        }
    }
    fn first(self) -> usize {
        match self {
            FrameChannel::Features(first, _) => BASE_CHANNELS + first,
            _ => 0,
        }
    }
}

impl Encoding {
    /// (channels in a texel, bytes of a texel) for `channels` values per pixel.
    fn texel(self, channels: usize) -> (usize, usize) {
        match self {
            Encoding::F32 => (channels, 4 * channels),
            Encoding::F32x4 => (4, 16),
            Encoding::F16x4 => (4, 8),
            Encoding::Unorm8x4 => (4, 4),
        }
    }
    /// Image layers for `channels` values per pixel.
    pub fn layers(self, channels: usize) -> usize {
        channels.div_ceil(self.texel(channels).0.max(1))
    }
    /// Bytes for `channels` values in each of `pixels` pixels.
    pub fn bytes(self, channels: usize, pixels: usize) -> usize {
        self.layers(channels) * pixels * self.texel(channels).1
    }
    fn index(self) -> u32 {
        match self {
            Encoding::F32 | Encoding::F32x4 => 0,
            Encoding::F16x4 => 1,
            Encoding::Unorm8x4 => 2,
        }
    }
}

/// Allocates a buffer of exactly [`Encoding::bytes`] for `pixels` pixels.
pub fn texels(
    device: &Device,
    pixels: usize,
    source: FrameChannel,
    encoding: Encoding,
) -> Result<Buffer<u32>> {
    Ok(device.buffer::<u32>("texels", encoding.bytes(source.channels(), pixels) / 4)?)
}

/// Packs the inner pixels of a band of a rendered frame into the [`texels`] of the image.
/// Reference: [`texels_of`].
pub fn pack(
    device: &Device,
    frame: &FrameBuffers,
    band: &Band,
    source: FrameChannel,
    encoding: Encoding,
    texels: &Buffer<u32>,
) -> Result<()> {
    let (stored, inner) = (frame.bands.stored(band), frame.bands.inner(band));
    if let FrameChannel::Features(first, count) = source
        && (count == 0 || first + count > frame.feature_dim)
    {
        return Err(Error::work(format!("the frame has no features {first} to {}", first + count)));
    }
    let channels = source.channels();
    let mut rec = Recorder::new(device, "pack");
    rec.dispatch_threads(
        shaders::pack::call(
            &shaders::pack::Bindings { planes: &frame.planes, transmittance: &frame.transmittance, texels },
            &shaders::pack::Push {
                pixels: frame.width * frame.height,
                source: source.index(),
                first: source.first() as u32,
                channels: channels as u32,
                group: encoding.texel(channels).0 as u32,
                encoding: encoding.index(),
                stride: frame.pixels(),
                from: stored.start as u32,
                to: inner.start as u32,
                count: inner.len() as u32,
            },
        ),
        [inner.len() as u32, 1, 1],
    );
    Ok(rec.run()?)
}

/// CPU reference of [`pack`]: bytes of the texels from `planes` [C, P] and `transmittance` [P].
pub fn texels_of(planes: &[f32], transmittance: &[f32], source: FrameChannel, encoding: Encoding) -> Vec<u8> {
    let pixels = transmittance.len();
    let channels = source.channels();
    let value = |p: usize, k: usize| match source {
        _ if k >= channels => 0.0,
        FrameChannel::Alpha => 1.0 - transmittance[p],
        FrameChannel::Colour if k == 3 => 1.0 - transmittance[p],
        FrameChannel::Depth => {
            let alpha = 1.0 - transmittance[p];
            if alpha >= super::renderer::DEPTH_ALPHA_MIN { planes[3 * pixels + p] / alpha } else { 0.0 }
        }
        FrameChannel::Colour | FrameChannel::Features(..) => planes[(source.first() + k) * pixels + p],
    };
    let (group, _) = encoding.texel(channels);
    let mut out = Vec::with_capacity(encoding.bytes(channels, pixels));
    for layer in 0..encoding.layers(channels) {
        for p in 0..pixels {
            for v in (0..group).map(|j| value(p, layer * group + j)) {
                match encoding {
                    Encoding::F32 | Encoding::F32x4 => out.extend(v.to_le_bytes()),
                    Encoding::F16x4 => out.extend(half::f16::from_f32(v).to_le_bytes()),
                    Encoding::Unorm8x4 => out.push((v.clamp(0.0, 1.0) * 255.0).round() as u8),
                }
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, TestDevice, test_device};
    use crate::pass::Rasterizer;

    #[test]
    fn pack_every_encoding_matches_reference() {
        let device = test_device();
        let (width, height, dim) = (19u32, 7u32, 6usize);
        let pixels = (width * height) as usize;
        let raster = Rasterizer::new(&device, 1, dim, width, height).unwrap();
        // Multiples of 1/64 are exact in half precision and keep the unorm values off the halves of
        // rounding.
        let noise = |i: usize| ((i * 7919 + 13) % 97) as f32 / 64.0;
        let planes: Vec<f32> = (0..(BASE_CHANNELS + dim) * pixels).map(noise).collect();
        let transmittance: Vec<f32> = (0..pixels).map(|i| (i % 9) as f32 / 8.0).collect();
        let band = raster.frame().bands.get(0);
        raster.frame().planes.write(&planes).unwrap();
        raster.frame().transmittance.write(&transmittance).unwrap();
        for source in
            [FrameChannel::Colour, FrameChannel::Alpha, FrameChannel::Depth, FrameChannel::Features(1, 5)]
        {
            for encoding in [Encoding::F32, Encoding::F32x4, Encoding::F16x4, Encoding::Unorm8x4] {
                let out = texels(&device, pixels, source, encoding).unwrap();
                pack(&device, raster.frame(), &band, source, encoding, &out).unwrap();
                let got = out.cast::<u8>().read().unwrap();
                let expected = texels_of(&planes, &transmittance, source, encoding);
                assert_eq!(got.len(), encoding.bytes(source.channels(), pixels), "{source:?} {encoding:?}");
                if encoding == Encoding::F16x4 && source == FrameChannel::Depth {
                    // z / alpha is not exact in half precision; rounding directions may differ by
                    // one step.
                    for (a, b) in got.chunks(2).zip(expected.chunks(2)) {
                        let step = |v: &[u8]| i32::from(u16::from_le_bytes([v[0], v[1]]));
                        assert!((step(a) - step(b)).abs() <= 1);
                    }
                } else if source == FrameChannel::Depth && encoding != Encoding::Unorm8x4 {
                    // Vulkan allows a quotient an error of 2.5 ULP; an NVIDIA H200 has such errors.
                    for (a, b) in got.chunks(4).zip(expected.chunks(4)) {
                        let unit = |v: &[u8]| i64::from(u32::from_le_bytes([v[0], v[1], v[2], v[3]]));
                        assert!((unit(a) - unit(b)).abs() <= 3, "{encoding:?}");
                    }
                } else {
                    assert_eq!(got, expected, "{source:?} {encoding:?}");
                }
            }
        }
        let out = device.buffer::<u32>("texels", 5 * pixels).unwrap();
        assert!(
            pack(&device, raster.frame(), &band, FrameChannel::Features(2, 5), Encoding::F32, &out).is_err()
        );
    }

    #[test]
    fn packed_bands_make_up_the_image() {
        let options = Options { max_binding: Some(1 << 18), ..crate::gpu::options(None) };
        let device = TestDevice::open(&options).unwrap();
        let (width, height, dim) = (80u32, 150u32, 3usize);
        let pixels = (width * height) as usize;
        let raster = Rasterizer::new(&device, 1, dim, width, height).unwrap();
        let bands = &raster.frame().bands;
        assert_eq!(bands.count(), 2);
        let noise = |i: usize| ((i * 7919 + 13) % 97) as f32 / 64.0;
        let planes: Vec<f32> = (0..(BASE_CHANNELS + dim) * pixels).map(noise).collect();
        let transmittance: Vec<f32> = (0..pixels).map(|i| (i % 9) as f32 / 8.0).collect();
        for (source, encoding) in
            [(FrameChannel::Colour, Encoding::F32), (FrameChannel::Features(1, 2), Encoding::F16x4)]
        {
            let out = texels(&device, pixels, source, encoding).unwrap();
            for band in bands.iter() {
                raster.frame().planes.write(&bands.cut(&band, &planes)).unwrap();
                raster.frame().transmittance.write(&bands.cut(&band, &transmittance)).unwrap();
                pack(&device, raster.frame(), &band, source, encoding, &out).unwrap();
            }
            let expected = texels_of(&planes, &transmittance, source, encoding);
            assert!(out.cast::<u8>().read().unwrap() == expected, "{source:?} {encoding:?}");
        }
    }
}
