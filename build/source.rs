//! Reading the shader sources: which files there are, what they include, which macro variants they ask for.
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The header whose inclusion makes a shader exist twice: with native float atomics and with the CAS loop.
const ATOMIC_FLOAT: &str = "shared/atomic_float.glsl";

/// One `glsl/NAME.comp`.
pub struct Source {
    pub name: String,
    pub path: PathBuf,
    pub text: String,
    /// All text the compiler will see, includes behind the file itself: what the cache key is made of.
    pub closure: String,
    /// `// variants: CHANNELS=3,4,20`: one entry per line, combined as a cartesian product.
    pub axes: Vec<(String, Vec<u32>)>,
    /// `// subgroups: 8,16,32`: compiled once per size (macro SUBGROUP_SIZE), chosen by the device at run time.
    pub subgroups: Vec<u32>,
    /// Whether the file includes `shared/atomic_float.glsl` (macro FLOAT_ATOMICS, chosen by the device at run time).
    pub float_atomics: bool,
}

/// Every `*.comp` directly under `glsl/`, sorted by name; tells cargo to watch each file read.
pub fn collect(glsl: &Path) -> Result<Vec<Source>, String> {
    // The folders as well as the files: a new file must start a rebuild.
    println!("cargo::rerun-if-changed={}", glsl.display());
    println!("cargo::rerun-if-changed={}", glsl.join("shared").display());
    let entries = std::fs::read_dir(glsl).map_err(|e| format!("{}: {e}", glsl.display()))?;
    let mut paths: Vec<PathBuf> = entries
        .filter_map(|e| e.ok().map(|e| e.path()))
        .filter(|p| p.extension().is_some_and(|x| x == "comp"))
        .collect();
    paths.sort();
    paths.iter().map(|p| read(glsl, p)).collect()
}

/// Name and text of every `glsl/shared/*.glsl`, sorted by name.
pub fn shared(glsl: &Path) -> Result<Vec<(String, String)>, String> {
    let folder = glsl.join("shared");
    let entries = std::fs::read_dir(&folder).map_err(|e| format!("{}: {e}", folder.display()))?;
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

fn read(glsl: &Path, path: &Path) -> Result<Source, String> {
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
    includes(glsl, path, &text, &mut seen, &mut closure)?;
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
    glsl: &Path,
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
        let path = glsl.join(&name);
        let inner = read_text(&path).map_err(|e| format!("{}:{}: error: {e}", from.display(), number + 1))?;
        closure.push_str(&inner);
        includes(glsl, &path, &inner, seen, closure)?;
    }
    Ok(())
}

fn read_text(path: &Path) -> Result<String, String> {
    println!("cargo::rerun-if-changed={}", path.display());
    std::fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))
}
