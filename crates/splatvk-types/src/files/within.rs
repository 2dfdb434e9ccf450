//! Resolution of file names that stand in other files.
use std::path::{Component, Path, PathBuf};

/// Path of a name that a file of `folder` contains; `None` where it lies outside: absolute, through
/// "..", or through a link. A missing file and a circle of links are left to the reader.
pub fn within(folder: &Path, name: &str) -> Option<PathBuf> {
    let below = |step| matches!(step, Component::Normal(_) | Component::CurDir);
    if name.contains('\\') || !Path::new(name).components().all(below) {
        return None;
    }
    let path = folder.join(name);
    match (path.canonicalize(), folder.canonicalize()) {
        (Ok(real), Ok(home)) if !real.starts_with(&home) => None,
        _ => Some(path),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_lead_nowhere_else() {
        let base = tempfile::tempdir().unwrap();
        let folder = base.path().join("scene");
        std::fs::create_dir_all(folder.join("images")).unwrap();
        std::fs::write(base.path().join("secret.png"), "x").unwrap();
        std::fs::write(folder.join("images/a.png"), "x").unwrap();
        assert_eq!(within(&folder, "./images/a.png"), Some(folder.join("./images/a.png")));
        assert_eq!(within(&folder, "images/none.png"), Some(folder.join("images/none.png")));
        let absolute = base.path().join("secret.png");
        for name in ["../secret.png", "images/../../secret.png", "..\\secret.png", absolute.to_str().unwrap()]
        {
            assert_eq!(within(&folder, name), None, "{name}");
        }
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(base.path(), folder.join("out")).unwrap();
            std::os::unix::fs::symlink(folder.join("images"), folder.join("in")).unwrap();
            assert_eq!(within(&folder, "out/secret.png"), None);
            assert_eq!(within(&folder, "in/a.png"), Some(folder.join("in/a.png")));
        }
    }
}
