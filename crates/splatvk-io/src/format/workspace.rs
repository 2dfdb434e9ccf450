//! Atomic creation of a scene directory: it is written to a hidden folder beside its place and
//! renamed at the end.
use super::scene_files;
use crate::files::{self, Kind, Partial, check_place, check_spared, restore, swap};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// A folder that is being written. Dropped without [`Workspace::commit`], it is removed together
/// with the folders that were created for it.
#[derive(Debug)]
pub struct Workspace {
    partial: Partial,
    out: PathBuf,
    force: bool,
    replaced: Replaced,
}

/// A kind of folder that is replaced as a whole.
#[derive(Clone, Copy, Debug)]
pub struct Replaced {
    /// Name of the kind for messages: "a scene".
    pub name: &'static str,
    /// Entries of such a folder that splatvk did not write; `None` for folders of another kind.
    pub foreign: fn(&Path) -> Option<Vec<String>>,
}

const SCENE: Replaced = Replaced { name: "a scene", foreign: scene_files::foreign };

impl Workspace {
    /// Reserves `out`: it must not exist, be an empty folder, or, with `force`, be a scene with
    /// only files of splatvk and none of the `inputs`. No other process writes there meanwhile.
    /// Nothing at `out` changes before [`Workspace::commit`], except that a scene which a killed
    /// process had moved aside is restored.
    pub fn create(out: &Path, force: bool, inputs: &[&Path]) -> Result<Workspace> {
        Workspace::replacing(out, force, inputs, SCENE)
    }

    /// Like [`Workspace::create`], for another kind of folder.
    pub fn replacing(out: &Path, force: bool, inputs: &[&Path], replaced: Replaced) -> Result<Workspace> {
        if out.file_name().is_none() {
            let out = out.display();
            return Err(Error::input(format!("{out}: not a folder name; choose one such as \"scene\"")));
        }
        // Anything but a folder is refused in any case.
        check_place(out, Kind::Folder, true)?;
        restore(out);
        if replaced.check(out, force)? {
            check_spared(out, inputs.iter().copied())?;
        }
        let partial = Partial::beside(out)?;
        std::fs::create_dir(partial.path()).map_err(Error::unwritable(out))?;
        Ok(Workspace { partial, out: out.to_path_buf(), force, replaced })
    }

    /// Folder to write to.
    pub fn path(&self) -> &Path {
        self.partial.path()
    }

    /// Place for a preview of the folder, which goes when the folder is moved or removed.
    pub fn preview(&self) -> PathBuf {
        self.partial.preview()
    }

    /// Moves the folder to its place; a scene that `force` permits to replace is removed only after
    /// that. Where an entry that may not be replaced came there meanwhile, the folder is moved
    /// beside it, and the error names that place.
    pub fn commit(self) -> Result<PathBuf> {
        let Workspace { partial, out, force, replaced } = self;
        let replaces = match check_place(&out, Kind::Folder, true).and_then(|()| replaced.check(&out, force))
        {
            Ok(replaces) => replaces,
            Err(e) => {
                let beside = files::next_free(&out);
                partial.finish(|path| std::fs::rename(path, &beside).map_err(Error::io(&beside)))?;
                return Err(Error::input(format!("{e} (the result is in {})", beside.display())));
            }
        };
        let aside = partial.aside();
        partial.finish(|path| {
            let moved = if replaces {
                swap(path, &out, &aside)
            } else {
                // Only leftovers are in it.
                files::sweep(&out);
                std::fs::rename(path, &out)
            };
            moved.map_err(Error::io(&out))
        })?;
        Ok(out)
    }
}

impl Replaced {
    /// Whether a folder at `out` exists and may be replaced; an error where anything else is there.
    fn check(&self, out: &Path, force: bool) -> Result<bool> {
        let (place, name) = (out.display(), self.name);
        match (self.foreign)(out) {
            Some(foreign) if !foreign.is_empty() => {
                files::check_free_inside(out)?;
                Err(Error::input(format!(
                    "{place}: holds {name}, and with it files of yours: {}; move them elsewhere, or choose another --out",
                    files::listed(&foreign)
                )))
            }
            Some(_) if !force => Err(Error::input(format!(
                "{place}: already holds {name}; choose another --out, or --force to replace it"
            ))),
            Some(_) => Ok(true),
            None => {
                files::check_free_inside(out)?;
                check_place(out, Kind::Folder, false).map(|()| false).map_err(|_| {
                    Error::input(format!(
                        "{place}: the folder is not empty and not {name}; choose another --out"
                    ))
                })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::scene_dir::{self, Contents};
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut v: Vec<_> = std::fs::read_dir(folder)
            .unwrap()
            .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        v.sort();
        v
    }

    /// A scene of `n` splats.
    fn write(folder: &Path, n: usize) -> Result<()> {
        let (splats, camera) = crate::scene::seeded::small(n, 64, 48, 1, 3);
        let contents = Contents {
            splats: &splats,
            seen: &crate::scene::Seen::default(),
            backdrop: &splats,
            holes: &splats,
            cameras: std::slice::from_ref(&camera),
            world: &Default::default(),
            photos: &[],
            points: None,
            language: None,
            text_embeddings: None,
        };
        scene_dir::write(folder, &contents)
    }

    fn splats(folder: &Path) -> usize {
        scene_dir::load(folder).unwrap().splats.len()
    }

    fn refused<T>(outcome: Result<T>, words: &str) {
        let e = outcome.err().unwrap();
        assert!(e.exit_code() == 2 && e.to_string().contains(words), "{words:?} is not in: {e}");
    }

    #[test]
    fn workspace_commit_is_atomic() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("deep/scene");
        let w = Workspace::create(&out, false, &[]).unwrap();
        write(w.path(), 10).unwrap();
        assert!(!out.exists());
        drop(w);
        assert!(names(folder.path()).is_empty(), "a dropped workspace leaves nothing");

        let w = Workspace::create(&out, false, &[]).unwrap();
        write(w.path(), 10).unwrap();
        w.commit().unwrap();
        assert_eq!(names(&folder.path().join("deep")), ["scene"]);
        refused(Workspace::create(&out, false, &[]), "--force");

        let w = Workspace::create(&out, true, &[]).unwrap();
        assert_eq!(splats(&out), 10, "untouched until the commit");
        write(w.path(), 20).unwrap();
        w.commit().unwrap();
        assert_eq!(splats(&out), 20);
        assert_eq!(names(&folder.path().join("deep")), ["scene"]);
    }

    #[test]
    fn workspace_refuses_second_writer() {
        let folder = tempfile::tempdir().unwrap();
        let (out, beside) = (folder.path().join("scene"), folder.path().join("scene-2"));
        for force in [false, true] {
            let w = Workspace::create(&out, force, &[]).unwrap();
            refused(Workspace::create(&out, true, &[]), "another splatvk is writing there");
            write(w.path(), 10).unwrap();
            // By another program, or by one that does not use marks.
            std::fs::create_dir(&out).unwrap();
            if force {
                std::fs::write(out.join("scene.json"), "{}").unwrap();
            } else {
                write(&out, 20).unwrap();
            }
            refused(w.commit(), "the result is in");
            assert!(splats(&beside) == 10 && (force || splats(&out) == 20));
            assert_eq!(names(folder.path()), ["scene", "scene-2"]);
            std::fs::remove_dir_all(&out).unwrap();
            std::fs::remove_dir_all(&beside).unwrap();
        }
    }

    #[test]
    fn workspace_never_replaces_foreign_files() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("scene");
        let w = Workspace::create(&out, false, &[]).unwrap();
        write(w.path(), 10).unwrap();
        w.commit().unwrap();
        std::fs::create_dir(out.join("previews")).unwrap();
        for name in ["NOTES.txt", "cameras/mine.json", "previews/IMG_1.jpg", "language"] {
            std::fs::write(out.join(name), "precious").unwrap();
            for force in [false, true] {
                refused(Workspace::create(&out, force, &[]), &format!("files of yours: {name};"));
            }
            let w = Workspace::create(&out.with_file_name("other"), true, &[]).unwrap();
            let w = Workspace { out: out.clone(), ..w };
            refused(w.commit(), name);
            std::fs::remove_dir(out.with_file_name("scene-2")).unwrap();
            assert_eq!(std::fs::read_to_string(out.join(name)).unwrap(), "precious");
            std::fs::remove_file(out.join(name)).unwrap();
        }
        let input = out.join("cameras/transforms.json");
        refused(Workspace::create(&out, true, &[&input]), "transforms.json: is read");
        refused(Workspace::create(&out, true, &[Path::new("elsewhere"), &out]), "scene: is read");
        drop(Workspace::create(&out, true, &[folder.path()]).unwrap());
        // Scenes of other programs, and of future versions, are foreign.
        for manifest in ["{}", r#"{"three": true}"#, r#"{"format": "splatvk-scene", "version": 999}"#] {
            std::fs::write(out.join("scene.json"), manifest).unwrap();
            refused(Workspace::create(&out, true, &[]), "not a scene");
        }
    }

    /// The symbolic link leads to a device on which every write fails with a full disk.
    #[cfg(target_os = "linux")]
    #[test]
    fn full_disk_keeps_old_scene() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("scene");
        std::fs::create_dir(&out).unwrap();
        write(&out, 10).unwrap();
        for full in ["point_cloud.ply", "cameras/transforms.json", "scene.json"] {
            let w = Workspace::create(&out, true, &[]).unwrap();
            let place = w.path().join(full);
            std::fs::create_dir_all(place.parent().unwrap()).unwrap();
            std::os::unix::fs::symlink("/dev/full", &place).unwrap();
            let e = write(w.path(), 40).unwrap_err();
            let Error::Unwritable { path, source } = &e else { panic!("{e:?}") };
            assert_eq!((path, source.kind()), (&place, std::io::ErrorKind::StorageFull));
            let text = e.to_string();
            assert!(
                e.exit_code() == 4 && text.lines().count() == 1 && text.contains("free some space"),
                "{e}"
            );
            drop(w);
            assert_eq!(names(folder.path()), ["scene"]);
            assert_eq!(splats(&out), 10);
        }
        let w = Workspace::create(&out, true, &[]).unwrap();
        write(w.path(), 40).unwrap();
        w.commit().unwrap();
        assert_eq!(splats(&out), 40);
    }

    #[test]
    fn workspace_refuses_other_folders() {
        let folder = tempfile::tempdir().unwrap();
        let precious = folder.path().join("photos");
        std::fs::create_dir(&precious).unwrap();
        std::fs::write(precious.join("a.jpg"), "x").unwrap();
        for force in [false, true] {
            assert_eq!(Workspace::create(&precious, force, &[]).unwrap_err().exit_code(), 2);
            let file = precious.join("a.jpg");
            assert_eq!(Workspace::create(&file, force, &[]).unwrap_err().exit_code(), 2);
            assert_eq!(Workspace::create(&file.join("scene"), force, &[]).unwrap_err().exit_code(), 2);
        }
        assert_eq!(names(folder.path()), ["photos"]);
        let left = folder.path().join(".scene.partial-splatvk");
        files::leave(&left).unwrap();
        refused(Workspace::create(&precious, true, &[]), "not empty");
        assert!(left.exists(), "a refused command sweeps nothing");
        drop(Workspace::create(&folder.path().join("scene"), false, &[]).unwrap());
        assert!(!left.exists(), "left by a process that is gone");
    }
}
