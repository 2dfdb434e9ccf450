//! A scene directory appears whole or not at all: work happens in a hidden folder beside it and is renamed in at the end.
use crate::{Error, Result};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Folders of this process that are not finished.
static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Removes every unfinished folder of this process: for exits that run no destructors.
pub fn remove_unfinished() {
    for folder in UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
        // Nothing more can be done about a folder that cannot be removed while exiting.
        let _ = std::fs::remove_dir_all(folder);
    }
}

/// A folder being written. Dropped without [`Workspace::commit`], it vanishes.
#[derive(Debug)]
pub struct Workspace {
    partial: PathBuf,
    out: PathBuf,
    done: bool,
}

/// File that marks a folder as a scene, and so as ours to replace.
pub(super) const MANIFEST: &str = "scene.json";

impl Workspace {
    /// Reserves `out`: it must not exist, be an empty folder, or, with `force`, hold a scene. Nothing at `out` changes
    /// before [`Workspace::commit`].
    pub fn create(out: &Path, force: bool) -> Result<Workspace> {
        let bad = |what: &str| Error::input(format!("{}: {what}", out.display()));
        let name = out.file_name().map(|n| n.to_string_lossy().into_owned());
        let name = name.ok_or_else(|| bad("not a folder name; choose one such as \"scene\""))?;
        if out.join(MANIFEST).is_file() {
            if !force {
                return Err(bad("already holds a scene; choose another --out, or --force to replace it"));
            }
        } else if out.is_dir() {
            let mut entries = std::fs::read_dir(out).map_err(Error::io(out))?;
            if entries.next().is_some() {
                return Err(bad("the folder is not empty and not a scene; choose another --out"));
            }
        } else if out.symlink_metadata().is_ok() {
            return Err(bad("a file is in the way; choose another --out"));
        }
        let parent = match out.parent() {
            Some(p) if !p.as_os_str().is_empty() => p.to_path_buf(),
            _ => PathBuf::from("."),
        };
        std::fs::create_dir_all(&parent).map_err(Error::unwritable(out))?;
        sweep(&parent, &name);
        let partial = parent.join(format!(".{name}.partial-{}", std::process::id()));
        std::fs::create_dir(&partial).map_err(Error::unwritable(out))?;
        UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner).push(partial.clone());
        Ok(Workspace { partial, out: out.to_path_buf(), done: false })
    }

    /// Where to write.
    pub fn path(&self) -> &Path {
        &self.partial
    }

    /// Moves the folder to its place; a scene that `force` allowed to replace is removed only after that.
    pub fn commit(mut self) -> Result<PathBuf> {
        let old = self.partial.with_extension(format!("old-{}", std::process::id()));
        let replaces = self.out.join(MANIFEST).is_file();
        if replaces {
            std::fs::rename(&self.out, &old).map_err(Error::io(&self.out))?;
        }
        if let Err(e) = std::fs::rename(&self.partial, &self.out) {
            if replaces {
                std::fs::rename(&old, &self.out).map_err(Error::io(&old))?;
            }
            return Err(Error::io(&self.out)(e));
        }
        self.done = true;
        forget(&self.partial);
        if replaces {
            std::fs::remove_dir_all(&old).map_err(Error::io(&old))?;
        }
        Ok(self.out.clone())
    }
}

impl Drop for Workspace {
    fn drop(&mut self) {
        if !self.done {
            // Dropping happens on the way out of an error, which is the one to report.
            let _ = std::fs::remove_dir_all(&self.partial);
            forget(&self.partial);
        }
    }
}

fn forget(folder: &Path) {
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner).retain(|p| p != folder);
}

/// Removes what killed runs for the same output left behind: partial folders whose process is gone.
fn sweep(parent: &Path, name: &str) {
    let prefix = format!(".{name}.partial-");
    let Ok(entries) = std::fs::read_dir(parent) else { return };
    for entry in entries.flatten() {
        let file = entry.file_name().to_string_lossy().into_owned();
        let Some(pid) = file.strip_prefix(&prefix).and_then(|p| p.parse::<u32>().ok()) else { continue };
        // Without /proc nobody can tell whether the other run still lives: leave it alone.
        if Path::new("/proc/self").exists() && !Path::new(&format!("/proc/{pid}")).exists() {
            let _ = std::fs::remove_dir_all(entry.path());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut v: Vec<_> = std::fs::read_dir(folder)
            .unwrap()
            .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        v.sort();
        v
    }

    #[test]
    fn whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("deep/scene");
        let w = Workspace::create(&out, false).unwrap();
        std::fs::write(w.path().join(MANIFEST), "1").unwrap();
        assert!(!out.exists());
        drop(w);
        assert!(names(&folder.path().join("deep")).is_empty(), "a dropped workspace leaves nothing");

        let w = Workspace::create(&out, false).unwrap();
        std::fs::write(w.path().join(MANIFEST), "1").unwrap();
        w.commit().unwrap();
        assert_eq!(names(&folder.path().join("deep")), ["scene"]);
        let e = Workspace::create(&out, false).unwrap_err();
        assert!(e.exit_code() == 2 && e.to_string().contains("--force"), "{e}");

        let w = Workspace::create(&out, true).unwrap();
        assert_eq!(std::fs::read_to_string(out.join(MANIFEST)).unwrap(), "1", "untouched until the commit");
        std::fs::write(w.path().join(MANIFEST), "2").unwrap();
        w.commit().unwrap();
        assert_eq!(std::fs::read_to_string(out.join(MANIFEST)).unwrap(), "2");
        assert_eq!(names(&folder.path().join("deep")), ["scene"]);
    }

    /// Opening the file gives a device on which every write says that the disk is full.
    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_leaves_the_old_scene_as_it_was() {
        use super::super::scene_dir::{self, Contents};
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("scene");
        std::fs::create_dir(&out).unwrap();
        std::fs::write(out.join(MANIFEST), "old").unwrap();
        let (splats, camera) = crate::pass::seeded::small(40, 64, 48, 1, 3);
        let contents = Contents {
            splats: &splats,
            seen: &crate::scene::Seen::default(),
            cameras: std::slice::from_ref(&camera),
            world: &Default::default(),
            photos: &[],
            points: None,
            language: None,
            text_embeddings: None,
        };
        for full in ["point_cloud.ply", "cameras/transforms.json", MANIFEST] {
            let w = Workspace::create(&out, true).unwrap();
            let place = w.path().join(full);
            std::fs::create_dir_all(place.parent().unwrap()).unwrap();
            std::os::unix::fs::symlink("/dev/full", &place).unwrap();
            let e = scene_dir::write(w.path(), &contents).unwrap_err();
            let Error::Unwritable { path, source } = &e else { panic!("{e:?}") };
            assert_eq!((path, source.kind()), (&place, std::io::ErrorKind::StorageFull));
            let text = e.to_string();
            assert!(
                e.exit_code() == 2 && text.lines().count() == 1 && text.contains("free some space"),
                "{e}"
            );
            drop(w);
            assert_eq!(names(folder.path()), ["scene"]);
            assert_eq!(std::fs::read_to_string(out.join(MANIFEST)).unwrap(), "old");
        }
        let w = Workspace::create(&out, true).unwrap();
        scene_dir::write(w.path(), &contents).unwrap();
        w.commit().unwrap();
        assert_eq!(scene_dir::load(&out).unwrap().splats.len(), 40);
    }

    #[test]
    fn what_is_not_a_scene_is_never_touched() {
        let folder = tempfile::tempdir().unwrap();
        let precious = folder.path().join("photos");
        std::fs::create_dir(&precious).unwrap();
        std::fs::write(precious.join("a.jpg"), "x").unwrap();
        for force in [false, true] {
            assert_eq!(Workspace::create(&precious, force).unwrap_err().exit_code(), 2);
            let file = precious.join("a.jpg");
            assert_eq!(Workspace::create(&file, force).unwrap_err().exit_code(), 2);
            assert_eq!(Workspace::create(&file.join("scene"), force).unwrap_err().exit_code(), 2);
        }
        assert_eq!(names(folder.path()), ["photos"]);
        let stale = folder.path().join(".scene.partial-4000000000");
        std::fs::create_dir(&stale).unwrap();
        drop(Workspace::create(&folder.path().join("scene"), false).unwrap());
        assert!(!stale.exists(), "left by a process that is gone");
    }
}
