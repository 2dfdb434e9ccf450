//! Notice of a large stage store.
use crate::pipeline::Store;
use crate::progress::Progress;
use crate::run::stage_folder;

/// Bytes of stages from which a run mentions them: some five scenes of four photos.
const WORTH_REPORTING: u64 = 1 << 30;

/// Reports the size of all stored stages and how to free them, if it is large.
pub(super) fn report_kept_stages(progress: &dyn Progress) {
    let Ok(folder) = stage_folder() else { return };
    if let Some(text) = notice(Store::list(&folder).iter().map(|f| f.1).sum()) {
        progress.inform(&format!("{text} ({})", folder.display()));
    }
}

fn notice(bytes: u64) -> Option<String> {
    (bytes > WORTH_REPORTING).then(|| {
        let size = bytes as f64 / f64::from(1 << 30);
        format!("stages kept for --resume hold {size:.1} GiB; splatvk clean --delete frees them")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_store_notice_names_remedy() {
        assert_eq!(notice(WORTH_REPORTING), None);
        let text = notice(4_400_000_000).unwrap();
        assert!(text.contains("4.1 GiB") && text.contains("splatvk clean --delete"), "{text}");
    }
}
