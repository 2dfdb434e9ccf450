//! What several stages need.
use crate::Result;
use crate::infer::installed::Installed;
use crate::scene::RgbImage;

/// The working images of photos.
pub(super) fn images(photos: &[crate::photo::Photo]) -> Vec<RgbImage> {
    photos.iter().map(|p| p.image.clone()).collect()
}

/// What an installed network is, for [`crate::pipeline::Stage::settings`].
pub fn identity(model: &Installed) -> Result<String> {
    let sums: Vec<String> = model.files()?.into_iter().map(|f| f.sha256).collect();
    Ok(format!("{} {sums:?}", model.name))
}
