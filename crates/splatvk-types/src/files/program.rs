//! The file of the running code, and the files installed beside it.
use std::io;
use std::path::{Path, PathBuf};

/// The file that holds this code: the program, or the shared library in a process of another
/// program (Python, a host of the C interface).
///
/// # Errors
/// The system does not state the program's path.
pub fn own_file() -> io::Result<PathBuf> {
    own_library().map_or_else(std::env::current_exe, Ok)
}

/// A file or folder of the installation that this code belongs to, by its path below the prefix;
/// `None` where it is absent. Packages can be unpacked anywhere, so the prefix follows from
/// [`own_file`].
pub fn installed(part: &str) -> Option<PathBuf> {
    let file = own_file().ok()?.canonicalize().ok()?;
    Some(prefix(&file)?.join(part)).filter(|path| path.exists())
}

/// The folder above `bin/FILE`, `lib/FILE` or Debian's `lib/TRIPLET/FILE`. No other folder counts:
/// code is loaded from below the prefix, and a program in a folder of `/tmp` must not take it from
/// what others put into `/tmp`.
fn prefix(file: &Path) -> Option<&Path> {
    let folder = file.parent()?;
    let named = |f: &Path, names: &[&str]| f.file_name().is_some_and(|n| names.iter().any(|&name| n == name));
    if named(folder, &["bin", "lib", "lib64"]) {
        return folder.parent();
    }
    let above = folder.parent()?;
    let triplet = folder.file_name()?.to_str()?.ends_with("-linux-gnu");
    above.parent().filter(|_| triplet && named(above, &["lib"]))
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn own_library() -> Option<PathBuf> {
    use std::os::unix::ffi::OsStrExt;
    let mut found = std::mem::MaybeUninit::<libc::Dl_info>::uninit();
    // SAFETY: an address of this library, and a place for the result, which is only read where the
    // call succeeds; the name lives as long as the library.
    let name = unsafe {
        if libc::dladdr(own_file as *const () as *const libc::c_void, found.as_mut_ptr()) == 0 {
            return None;
        }
        std::ffi::CStr::from_ptr(found.assume_init().dli_fname)
    };
    let path = PathBuf::from(std::ffi::OsStr::from_bytes(name.to_bytes()));
    let is_library = path.file_name()?.to_string_lossy().contains(".so");
    is_library.then_some(path)
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn own_library() -> Option<PathBuf> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prefix_follows_from_known_folders() {
        let of = |file: &str| prefix(Path::new(file)).map(|p| p.to_string_lossy().into_owned());
        for (file, wanted) in [
            ("/opt/splatvk/bin/splatvk", Some("/opt/splatvk")),
            ("/usr/lib64/libsplatvk.so.0.1.0", Some("/usr")),
            ("/usr/lib/x86_64-linux-gnu/libsplatvk.so.0.1.0", Some("/usr")),
            ("/tmp/download/splatvk", None),
            ("/tmp/x86_64-linux-gnu/libsplatvk.so", None),
            ("/home/a/target/release/splatvk", None),
        ] {
            assert_eq!(of(file).as_deref(), wanted, "{file}");
        }
    }

    #[test]
    fn own_file_is_the_test_program() {
        assert_eq!(own_file().unwrap(), std::env::current_exe().unwrap());
    }
}
