//! Metadata of image files.

/// Largest ICC profile that is read, bytes: those of printers with 16-bit tables have 3 MB.
pub(super) const LARGEST_ICC: usize = 4 << 20;
pub(super) const ICC_TOO_LARGE: &str = "its ICC profile is larger than 4 MiB and is not used";
/// Largest XMP packet that is read, bytes. In JPEG files it has 64 KiB at most.
pub(super) const LARGEST_XMP: usize = 1 << 20;

/// Raw blocks and numbers.
#[derive(Default)]
pub(super) struct Metadata {
    /// TIFF bytes of the EXIF block.
    pub exif: Option<Vec<u8>>,
    /// The ICC profile.
    pub icc: Option<Vec<u8>>,
    /// The XMP packet.
    pub xmp: Option<Vec<u8>>,
    /// Primaries, transfer, matrix and full range by the code points of ITU-T H.273.
    pub code_points: Option<[u16; 4]>,
    /// Whether the code points take precedence over the profile.
    pub code_points_first: bool,
    /// Whether the colours are Adobe RGB where there is no profile.
    pub adobe_rgb: bool,
    /// Whether the file states that its colours are sRGB.
    pub is_srgb: bool,
    /// Exponent from light to stored numbers.
    pub gamma: Option<f64>,
    /// x and y of white, red, green and blue.
    pub chromaticities: Option<[f64; 8]>,
    /// Notes on parts that are not used, with the reason, for a warning that begins with the file's
    /// name.
    pub notes: Vec<String>,
}

impl Metadata {
    /// Drops blocks that exceed their bound.
    pub fn bounded(mut self) -> Metadata {
        if self.icc.as_ref().is_some_and(|icc| icc.len() > LARGEST_ICC) {
            self.icc = None;
            self.notes.push(ICC_TOO_LARGE.to_owned());
        }
        self.xmp = self.xmp.filter(|xmp| xmp.len() <= LARGEST_XMP);
        self
    }
}
