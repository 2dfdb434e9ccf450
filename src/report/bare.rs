//! Removal of local folders from file names, since reports are shared.
use serde_json::Value;
use std::path::{MAIN_SEPARATOR, Path};

/// Removes the parent folders of the paths that a user typed from all texts:
/// `/home/me/photos/a.jpg` becomes `photos/a.jpg` where `/home/me/photos` was typed, and `a.jpg`
/// where it was typed itself.
pub(super) fn bare<'a>(value: &mut Value, typed: impl IntoIterator<Item = &'a Path>) {
    let folder = |path: &Path| Some(path.parent()?.to_string_lossy().into_owned());
    let mut folders: Vec<String> = typed.into_iter().filter_map(folder).filter(|f| !f.is_empty()).collect();
    // Nested folders are removed first, as a whole.
    folders.sort_by_key(|f| std::cmp::Reverse(f.len()));
    folders.dedup();
    for folder in &mut folders {
        if !folder.ends_with(MAIN_SEPARATOR) {
            folder.push(MAIN_SEPARATOR);
        }
    }
    walk(value, &folders);
}

fn walk(value: &mut Value, folders: &[String]) {
    match value {
        Value::String(text) => folders.iter().for_each(|folder| *text = without(text, folder)),
        Value::Array(all) => all.iter_mut().for_each(|v| walk(v, folders)),
        Value::Object(all) => all.values_mut().for_each(|v| walk(v, folders)),
        _ => {}
    }
}

/// Removes the name of a folder from a text wherever a path begins with it.
fn without(text: &str, folder: &str) -> String {
    let mut left = String::with_capacity(text.len());
    let mut pieces = text.split(folder);
    left.extend(pieces.next());
    for piece in pieces {
        // Inside a longer path it is another folder of the same name.
        if !left.chars().next_back().is_none_or(|c| c.is_whitespace() || "\"'“‘(:,;=".contains(c)) {
            left.push_str(folder);
        }
        left.push_str(piece);
    }
    left
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bare_removes_folders_of_typed_paths() {
        let typed = ["/home/me/photos", "/home/me/more/b.jpg", "../up/scene", "here", "a/deep/masks"];
        let mut value = serde_json::json!({
            "inputs": ["/home/me/photos", "/home/me/more/b.jpg"], "out": "../up/scene", "masks": "dir:a/deep/masks", "n": 3,
            "warnings": ["/home/me/photos/notes.txt: not a photo; (/home/me/photos/x.jpg), here/y.jpg, data/deep/masks"],
        });
        bare(&mut value, typed.map(Path::new));
        let left = serde_json::json!({
            "inputs": ["photos", "b.jpg"], "out": "scene", "masks": "dir:masks", "n": 3,
            "warnings": ["photos/notes.txt: not a photo; (photos/x.jpg), here/y.jpg, data/deep/masks"],
        });
        assert_eq!(value, left);
    }
}
