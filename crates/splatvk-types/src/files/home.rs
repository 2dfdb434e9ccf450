//! The program's own folder.
use crate::{Error, Result};
use std::path::PathBuf;

/// The folder that set-up fills: `SPLATVK_HOME`, else `splatvk` in the user's data folder
/// (`XDG_DATA_HOME`, else `.local/share` in `HOME`, else in the home directory of the system's user
/// database). Code is loaded from there, so a relative `XDG_DATA_HOME` or `HOME`, which would mean
/// the current folder, is ignored; [`Error::Missing`] where no folder remains.
pub fn home() -> Result<PathBuf> {
    choose(|name| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from), std::env::home_dir())
}

fn choose(set: impl Fn(&str) -> Option<PathBuf>, user: Option<PathBuf>) -> Result<PathBuf> {
    if let Some(own) = set("SPLATVK_HOME") {
        return std::path::absolute(&own).map_err(Error::io(own));
    }
    let user = || user.filter(|p| p.is_absolute()).map(|p| p.join(".local/share"));
    match set("XDG_DATA_HOME").filter(|p| p.is_absolute()).or_else(user) {
        Some(data) => Ok(data.join("splatvk")),
        None => Err(Error::missing(
            "no folder for models and kept work: HOME and XDG_DATA_HOME are not absolute paths; set HOME, or SPLATVK_HOME to a \
             folder of your own",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The folder with these values of `SPLATVK_HOME`, `XDG_DATA_HOME` and the home directory.
    fn chosen(own: &str, data: &str, user: Option<&str>) -> Result<PathBuf> {
        let set = |name: &str| match name {
            "SPLATVK_HOME" => Some(own),
            "XDG_DATA_HOME" => Some(data),
            _ => None,
        };
        let set = |name: &str| set(name).filter(|v| !v.is_empty()).map(PathBuf::from);
        choose(set, user.map(PathBuf::from))
    }

    #[test]
    fn home_ignores_relative_variables() {
        let some_path = |path: &str| Some(PathBuf::from(path));
        assert_eq!(chosen("", "/data", Some("/home/a")).ok(), some_path("/data/splatvk"));
        assert_eq!(chosen("", "data", Some("/home/a")).ok(), some_path("/home/a/.local/share/splatvk"));
        assert_eq!(chosen("/own", "data", None).ok(), some_path("/own"));
        assert!(chosen("own", "", None).unwrap().is_absolute());
        for user in [None, Some("home"), Some("")] {
            let e = chosen("", "data", user).unwrap_err();
            assert!(e.exit_code() == 3 && e.to_string().contains("SPLATVK_HOME"), "{e}");
        }
    }
}
