//! What a file says beside its pixels.

/// Largest ICC profile that is read, bytes: those of printers with tables of 16 bits have 3 MB.
pub(super) const LARGEST_ICC: usize = 4 << 20;
pub(super) const ICC_TOO_LARGE: &str = "its ICC profile is larger than 4 MiB and is not used";
/// Largest XMP packet that is read, bytes. In JPEG files one has 64 KiB at most.
pub(super) const LARGEST_XMP: usize = 1 << 20;

/// Raw blocks and numbers, none of them larger than its bound.
#[derive(Default)]
pub(super) struct Metadata {
    /// TIFF bytes of the EXIF block.
    pub exif: Option<Vec<u8>>,
    /// The ICC profile.
    pub icc: Option<Vec<u8>>,
    /// The XMP packet.
    pub xmp: Option<Vec<u8>>,
    /// Primaries, transfer, matrix and full range by the numbers of ITU-T H.273.
    pub code_points: Option<[u16; 4]>,
    /// They count before the profile.
    pub code_points_first: bool,
    /// The colours are those of Adobe RGB, where there is no profile.
    pub adobe_rgb: bool,
    /// The file says that its colours are sRGB.
    pub is_srgb: bool,
    /// Exponent from light to stored numbers.
    pub gamma: Option<f64>,
    /// x and y of white, red, green and blue.
    pub chromaticities: Option<[f64; 8]>,
    /// What is not used, and why: a sentence each, for a warning that begins with the file's name.
    pub notes: Vec<String>,
}

impl Metadata {
    /// Without what is larger than its bound.
    pub fn bounded(mut self) -> Metadata {
        if self.icc.as_ref().is_some_and(|icc| icc.len() > LARGEST_ICC) {
            self.icc = None;
            self.notes.push(ICC_TOO_LARGE.to_owned());
        }
        self.xmp = self.xmp.filter(|xmp| xmp.len() <= LARGEST_XMP);
        self
    }
}
