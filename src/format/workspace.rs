//! A scene directory appears whole or not at all: work happens in a hidden folder beside it and is renamed in at the end.
use crate::files::{Kind, Partial, check_place, restore, swap};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// A folder being written. Dropped without [`Workspace::commit`], it vanishes, and so do the folders that were made for it.
#[derive(Debug)]
pub struct Workspace {
    partial: Partial,
    out: PathBuf,
    replaced: Replaced,
}

/// A kind of folder that is replaced as a whole.
#[derive(Clone, Copy, Debug)]
pub struct Replaced {
    /// "a scene", for messages.
    pub name: &'static str,
    /// Whether a folder is one, and so ours to replace.
    pub is: fn(&Path) -> bool,
}

/// File that marks a folder as a scene, and so as ours to replace.
pub(super) const MANIFEST: &str = "scene.json";

const SCENE: Replaced = Replaced { name: "a scene", is: |folder| folder.join(MANIFEST).is_file() };

impl Workspace {
    /// Reserves `out`: it must not exist, be an empty folder, or, with `force`, hold a scene. Nothing at `out` changes
    /// before [`Workspace::commit`], except that a scene which a killed process was about to replace comes back.
    pub fn create(out: &Path, force: bool) -> Result<Workspace> {
        Workspace::replacing(out, force, SCENE)
    }

    /// [`Workspace::create`] of another kind of folder.
    pub fn replacing(out: &Path, force: bool, replaced: Replaced) -> Result<Workspace> {
        let bad = |what: &str| Error::input(format!("{}: {what}", out.display()));
        if out.file_name().is_none() {
            return Err(bad("not a folder name; choose one such as \"scene\""));
        }
        // What is no folder is refused in any case.
        check_place(out, Kind::Folder, true)?;
        restore(out);
        let (is_one, name) = ((replaced.is)(out), replaced.name);
        if is_one && !force {
            return Err(bad(&format!(
                "already holds {name}; choose another --out, or --force to replace it"
            )));
        }
        if !is_one && check_place(out, Kind::Folder, false).is_err() {
            return Err(bad(&format!("the folder is not empty and not {name}; choose another --out")));
        }
        let partial = Partial::beside(out, true).map_err(Error::unwritable(out))?;
        std::fs::create_dir(partial.path()).map_err(Error::unwritable(out))?;
        Ok(Workspace { partial, out: out.to_path_buf(), replaced })
    }

    /// Where to write.
    pub fn path(&self) -> &Path {
        self.partial.path()
    }

    /// Moves the folder to its place; a scene that `force` allowed to replace is removed only after that.
    pub fn commit(self) -> Result<PathBuf> {
        let Workspace { partial, out, replaced } = self;
        let replaces = (replaced.is)(&out);
        // What came there meanwhile is not ours.
        check_place(&out, Kind::Folder, replaces)?;
        let garbage = partial.path().to_path_buf();
        partial.finish(|path| {
            let moved = if replaces { swap(path, &out) } else { std::fs::rename(path, &out) };
            // From here on the old one is a leftover, should the process end before it is removed.
            moved.map_err(Error::io(&out))
        })?;
        if replaces {
            std::fs::remove_dir_all(&garbage).map_err(Error::io(&garbage))?;
        }
        Ok(out)
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
        assert!(names(folder.path()).is_empty(), "a dropped workspace leaves nothing");

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
