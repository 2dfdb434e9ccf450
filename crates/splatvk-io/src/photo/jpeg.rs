//! Completeness of JPEG files: the decoder silently fills a truncated one with grey, and grey areas
//! would become geometry.
use super::kind::check_pixels;
use image::codecs::jpeg::JpegDecoder;
use image::{DynamicImage, ImageDecoder};
use sha2::{Digest, Sha256};
use std::io::Cursor;

/// Whether the end-of-image marker is reached.
pub(super) fn has_end(bytes: &[u8]) -> bool {
    walk(bytes, |_, _| {})
}

/// Calls `segment` with the marker and content of every segment; returns whether the end-of-image
/// marker is reached.
fn walk(bytes: &[u8], mut segment: impl FnMut(u8, &[u8])) -> bool {
    let mut at = 2;
    let mut in_scan = false;
    while at + 1 < bytes.len() {
        if bytes[at] != 0xff {
            // Entropy-coded data, or stray bytes between segments that decoders skip, too.
            at += 1;
            continue;
        }
        match bytes[at + 1] {
            0xd9 => return true,
            // A stuffed byte, a restart marker, or a second 0xff of padding.
            0x00 if in_scan => at += 2,
            0x01 | 0xd0..=0xd8 => at += 2,
            0xff => at += 1,
            marker => {
                let Some(length) = bytes.get(at + 2..at + 4) else { return false };
                in_scan = marker == 0xda || in_scan;
                let end = at + 2 + u16::from_be_bytes([length[0], length[1]]) as usize;
                segment(marker, bytes.get(at + 4..end).unwrap_or_default());
                at = end;
            }
        }
    }
    false
}

/// Bytes to append to a file without its end. Every Huffman code reads them differently, so that
/// missing pixels decode differently.
const FILLERS: [u8; 4] = [0x00, 0x55, 0xaa, 0x36];
/// Number of bytes to append: the first missing block is enough.
const FILLED: usize = 4096;

/// Whether a file without its end marker contains all pixels: no appended bytes change any of them.
/// Only for sequential files whose scans contain all components; a progressive file may lack whole
/// scans.
pub(super) fn has_all_pixels(bytes: &[u8]) -> bool {
    let (mut components, mut scanned, mut is_sequential) = (0, 0, false);
    walk(bytes, |marker, content| match marker {
        0xc0 | 0xc1 => {
            is_sequential = true;
            components = content.get(5).copied().map_or(0, usize::from);
        }
        0xda => scanned += content.first().copied().map_or(0, usize::from),
        _ => {}
    });
    if !is_sequential || components == 0 || scanned != components {
        return false;
    }
    // The first half of the marker may be there.
    let body = bytes.strip_suffix(&[0xff]).unwrap_or(bytes);
    let filled_with = |filler: &u8| pixel_checksum([body, &[*filler; FILLED], &[0xff, 0xd9]].concat());
    let first = filled_with(&FILLERS[0]);
    first.is_some() && FILLERS[1..].iter().all(|filler| filled_with(filler) == first)
}

/// Checksum of the decoded pixels.
fn pixel_checksum(file: Vec<u8>) -> Option<[u8; 32]> {
    let decoder = JpegDecoder::new(Cursor::new(file)).ok()?;
    let (w, h) = decoder.dimensions();
    check_pixels(w.into(), h.into()).ok()?;
    Some(Sha256::digest(DynamicImage::from_decoder(decoder).ok()?.as_bytes()).into())
}
