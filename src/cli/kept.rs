//! What a run leaves for the next, where it is much.
use crate::pipeline::Store;
use crate::progress::Progress;
use crate::run::stage_folder;

/// Bytes of stages from which on a run names them: some five scenes of four photos.
const WORTH_TELLING: u64 = 1 << 30;

/// Says how much the stages of this and earlier runs hold, and how to free it; nothing where that
/// is little.
pub(super) fn tell_of_kept_stages(progress: &dyn Progress) {
    let Ok(folder) = stage_folder() else { return };
    if let Some(text) = told(Store::list(&folder).iter().map(|f| f.1).sum()) {
        progress.inform(&format!("{text} ({})", folder.display()));
    }
}

fn told(bytes: u64) -> Option<String> {
    (bytes > WORTH_TELLING).then(|| {
        let size = bytes as f64 / f64::from(1 << 30);
        format!("stages kept for --resume hold {size:.1} GiB; splatvk clean --delete frees them")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn much_is_told_with_its_remedy() {
        assert_eq!(told(WORTH_TELLING), None);
        let text = told(4_400_000_000).unwrap();
        assert!(text.contains("4.1 GiB") && text.contains("splatvk clean --delete"), "{text}");
    }
}
