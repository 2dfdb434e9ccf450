//! Sizes of photos before decoding: for estimates of memory, and for the number of files that are
//! decoded at once.
use super::candidate::Candidate;
use super::header;
use std::ops::Range;

/// Largest total of decoded bytes at a time. A photo of 12 megapixels is 36 MB, one of 100
/// megapixels 300 MB, and two cores are busy with two of either.
const DECODED_AT_ONCE: u64 = 640 << 20;

/// Bytes of a decoded pixel: 8-bit RGB, and the same again for buffers of some decoders.
const DECODED_PIXEL: u64 = 6;

/// Assumed size of a photo whose size only its decoder determines (HEIC, frames of videos): the 48
/// megapixels of today's phones.
const ASSUMED: (usize, usize) = (8064, 6048);

/// Upright (width, height) of candidates.
pub fn sizes_of(candidates: &[Candidate]) -> Vec<(usize, usize)> {
    candidates.iter().map(|c| header::upright_size(&c.path).unwrap_or(ASSUMED)).collect()
}

/// Ranges of consecutive photos to decode in parallel.
pub(super) fn waves(candidates: &[Candidate]) -> Vec<Range<usize>> {
    let bytes: Vec<u64> = sizes_of(candidates).iter().map(|(w, h)| (w * h) as u64 * DECODED_PIXEL).collect();
    grouped(&bytes)
}

fn grouped(bytes: &[u64]) -> Vec<Range<usize>> {
    let mut waves: Vec<Range<usize>> = Vec::new();
    let mut held = 0;
    for (i, &own) in bytes.iter().enumerate() {
        match waves.last_mut().filter(|_| held + own <= DECODED_AT_ONCE) {
            Some(wave) => wave.end = i + 1,
            None => {
                waves.push(i..i + 1);
                held = 0;
            }
        }
        held += own;
    }
    waves
}

#[cfg(test)]
mod tests {
    use super::super::exif_tags::tests::block;
    use super::*;
    use exif::{Tag, Value};
    use image::ImageEncoder;

    #[test]
    fn waves_bound_decoded_bytes() {
        let mp = |n: u64| n * 1_000_000 * DECODED_PIXEL;
        assert_eq!(grouped(&[mp(12), mp(12), mp(100)]), [0..2, 2..3]);
        assert_eq!(grouped(&[mp(100); 3]), [0..1, 1..2, 2..3]);
        assert_eq!(grouped(&[mp(1), mp(100), mp(12), mp(100)]), [0..2, 2..3, 3..4]);
        assert!(grouped(&[]).is_empty());
    }

    #[test]
    fn sizes_of_reads_upright_headers() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("wide.png");
        image::RgbImage::new(300, 40).save(&path).unwrap();
        std::fs::write(folder.path().join("none.png"), b"no image").unwrap();
        // Stored on its side, as phones do.
        let tall = folder.path().join("tall.png");
        let mut encoder = image::codecs::png::PngEncoder::new(std::fs::File::create(&tall).unwrap());
        encoder.set_exif_metadata(block(&[(Tag::Orientation, Value::Short(vec![6]))])).unwrap();
        encoder.write_image(&[0; 300 * 40], 300, 40, image::ExtendedColorType::L8).unwrap();
        let files = [path, tall, folder.path().join("none.png")].map(|p| Candidate::file(&p));
        assert_eq!(sizes_of(&files), [(300, 40), (40, 300), ASSUMED]);
    }
}
