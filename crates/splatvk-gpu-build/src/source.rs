//! Shader sources: the files, their includes, and the macro variants they
//! ask for.
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The header of this crate. A shader that includes it is compiled with native float atomics and
/// with a compare-and-swap loop.
const ATOMIC_FLOAT: &str = "gpu/atomic_float.glsl";

/// The text of an included file. `name` is relative to the folder of shaders, or a header of this
/// crate.
pub fn included(folder: &Path, name: &str) -> Result<String, String> {
    match name {
        ATOMIC_FLOAT => Ok(include_str!("../include/atomic_float.glsl").to_owned()),
        _ => read_text(&folder.join(name)),
    }
}

/// One shader, `NAME.comp`.
pub struct Source {
    pub name: String,
    pub path: PathBuf,
    pub text: String,
    /// The file and all files that it includes: part of the cache key.
    pub closure: String,
    /// `// variants: CHANNELS=3,4,20`: one entry per line, combined as a cartesian product.
    pub axes: Vec<(String, Vec<u32>)>,
    /// `// subgroups: 8,16,32`: compiled once per size (macro SUBGROUP_SIZE), chosen by the device
    /// at run time.
    pub subgroups: Vec<u32>,
    /// The file includes `gpu/atomic_float.glsl` (macro FLOAT_ATOMICS, chosen by the device at run
    /// time).
    pub float_atomics: bool,
}

/// Every `*.comp` directly in the folder, sorted by name. Cargo watches each file read.
pub fn collect(folder: &Path) -> Result<Vec<Source>, String> {
    // The folders as well as the files: a new file must start a rebuild.
    println!("cargo::rerun-if-changed={}", folder.display());
    // Cargo would run the script each time if it watched a folder that is not there.
    let shared = folder.join("shared");
    if shared.exists() {
        println!("cargo::rerun-if-changed={}", shared.display());
    }
    let entries = std::fs::read_dir(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    let mut paths: Vec<PathBuf> = entries
        .filter_map(|e| e.ok().map(|e| e.path()))
        .filter(|p| p.extension().is_some_and(|x| x == "comp"))
        .collect();
    paths.sort();
    paths.iter().map(|p| read(folder, p)).collect()
}

/// Name and text of every `shared/*.glsl`, sorted by name.
pub fn shared(folder: &Path) -> Result<Vec<(String, String)>, String> {
    let shared = folder.join("shared");
    if !shared.exists() {
        return Ok(Vec::new());
    }
    let entries = std::fs::read_dir(&shared).map_err(|e| format!("{}: {e}", shared.display()))?;
    let mut files = Vec::new();
    for path in entries.filter_map(|e| e.ok().map(|e| e.path())) {
        if path.extension().is_some_and(|x| x == "glsl") {
            let name = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
            files.push((name, read_text(&path)?));
        }
    }
    files.sort();
    Ok(files)
}

fn read(folder: &Path, path: &Path) -> Result<Source, String> {
    let text = read_text(path)?;
    let name = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    if name.is_empty() || !name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_') {
        return Err(format!(
            "{}: the file name must be snake_case, it becomes a Rust module",
            path.display()
        ));
    }
    let mut seen = BTreeSet::new();
    let mut closure = text.clone();
    includes(folder, path, &text, &mut seen, &mut closure)?;
    let mut source = Source {
        name,
        path: path.to_path_buf(),
        closure,
        axes: Vec::new(),
        subgroups: Vec::new(),
        float_atomics: seen.contains(ATOMIC_FLOAT),
        text,
    };
    for (number, line) in source.text.lines().enumerate() {
        let at = || format!("{}:{}", path.display(), number + 1);
        if let Some(rest) = line.strip_prefix("// variants:") {
            let (macro_name, values) = rest
                .split_once('=')
                .ok_or_else(|| format!("{}: error: expected `// variants: MACRO=1,2`", at()))?;
            source.axes.push((macro_name.trim().to_owned(), numbers(values, &at())?));
        } else if let Some(rest) = line.strip_prefix("// subgroups:") {
            source.subgroups = numbers(rest, &at())?;
        }
    }
    Ok(source)
}

fn numbers(text: &str, at: &str) -> Result<Vec<u32>, String> {
    text.split(',')
        .map(|v| v.trim().parse().map_err(|_| format!("{at}: error: `{}` is not a whole number", v.trim())))
        .collect()
}

fn includes(
    folder: &Path,
    from: &Path,
    text: &str,
    seen: &mut BTreeSet<String>,
    closure: &mut String,
) -> Result<(), String> {
    for (number, line) in text.lines().enumerate() {
        let Some(rest) = line.trim_start().strip_prefix("#include") else { continue };
        let name = rest.trim().trim_matches('"').to_owned();
        if !seen.insert(name.clone()) {
            continue;
        }
        let inner =
            included(folder, &name).map_err(|e| format!("{}:{}: error: {e}", from.display(), number + 1))?;
        closure.push_str(&inner);
        includes(folder, &folder.join(&name), &inner, seen, closure)?;
    }
    Ok(())
}

fn read_text(path: &Path) -> Result<String, String> {
    println!("cargo::rerun-if-changed={}", path.display());
    std::fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))
}
