//! GLSL to SPIR-V with shaderc: once unoptimised for reflection, because the optimiser drops all
//! names, and once optimised for embedding. A cache in `OUT_DIR` keeps both; its key covers every
//! input.
use crate::constants::{self, Constant};
use crate::reflect::{self, Reflection};
use crate::source::{self, Source};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Raise when the options below change, so that cached modules are not reused.
const CACHE_VERSION: u32 = 1;

/// Folder of compiled modules in the cache.
pub const FOLDER: &str = "spirv";

/// One shader file with all its compiled modules.
pub struct Family {
    pub name: String,
    pub path: PathBuf,
    /// Macro names the host chooses, in the order of the file.
    pub axes: Vec<String>,
    pub constants: Vec<Constant>,
    pub modules: Vec<Module>,
}

/// One compiled module.
pub struct Module {
    /// Values of [`Family::axes`].
    pub variant: Vec<u32>,
    pub subgroup_size: Option<u32>,
    pub float_atomics: Option<bool>,
    /// Name of the file in [`FOLDER`].
    pub spirv: String,
    pub reflection: Reflection,
}

pub struct Compiler {
    shaderc: shaderc::Compiler,
    cache: PathBuf,
}

impl Compiler {
    pub fn new(out_dir: &Path) -> Result<Self, String> {
        let cache = out_dir.join(FOLDER);
        std::fs::create_dir_all(&cache).map_err(|e| format!("{}: {e}", cache.display()))?;
        let shaderc = shaderc::Compiler::new().map_err(|e| format!("shaderc did not start: {e}"))?;
        Ok(Self { shaderc, cache })
    }

    /// Compiles every variant of a file, or takes it from the cache.
    pub fn family(&self, source: &Source) -> Result<Family, String> {
        let mut modules = Vec::new();
        for job in jobs(source) {
            let (spirv, reflection) = self.module(source, &job.macros)?;
            let Job { variant, subgroup_size, float_atomics, .. } = job;
            modules.push(Module { variant, subgroup_size, float_atomics, spirv, reflection });
        }
        let axes = source.axes.iter().map(|(n, _)| n.clone()).collect();
        let constants = constants::of(&source.text);
        Ok(Family { name: source.name.clone(), path: source.path.clone(), axes, constants, modules })
    }

    /// Fills the cache on all cores. Errors are left to [`Compiler::family`], which meets them
    /// again in a fixed order.
    pub fn warm(out_dir: &Path, sources: &[Source]) {
        let all: Vec<(&Source, Job)> =
            sources.iter().flat_map(|s| jobs(s).into_iter().map(move |j| (s, j))).collect();
        let next = AtomicUsize::new(0);
        let workers = std::thread::available_parallelism().map_or(1, |n| n.get());
        std::thread::scope(|scope| {
            for _ in 0..workers {
                scope.spawn(|| {
                    let Ok(compiler) = Compiler::new(out_dir) else { return };
                    while let Some((source, job)) = all.get(next.fetch_add(1, Ordering::Relaxed)) {
                        let _ = compiler.module(source, &job.macros);
                    }
                });
            }
        });
    }

    /// One module: the file name of its optimised SPIR-V and the reflection of the unoptimised one.
    fn module(&self, source: &Source, macros: &[(String, u32)]) -> Result<(String, Reflection), String> {
        let mut hasher = DefaultHasher::new();
        (CACHE_VERSION, &source.path, &source.closure, macros).hash(&mut hasher);
        let stem = format!("{}-{:016x}", source.name, hasher.finish());
        let optimised = self.cache.join(format!("{stem}.spv"));
        let plain = self.cache.join(format!("{stem}.reflect.spv"));
        if !optimised.exists() || !plain.exists() {
            self.compile(source, macros, shaderc::OptimizationLevel::Zero, &plain)?;
            self.compile(source, macros, shaderc::OptimizationLevel::Performance, &optimised)?;
        }
        let words = read_words(&plain)?;
        let reflection =
            reflect::reflect(&words).map_err(|e| format!("{}: error: {e}", source.path.display()))?;
        Ok((format!("{stem}.spv"), reflection))
    }

    fn compile(
        &self,
        source: &Source,
        macros: &[(String, u32)],
        level: shaderc::OptimizationLevel,
        target: &Path,
    ) -> Result<(), String> {
        let mut options = shaderc::CompileOptions::new().map_err(|e| format!("shaderc options: {e}"))?;
        // SPIR-V 1.6 would emit LocalSizeId, which needs maintenance4 and which naga cannot read.
        options.set_target_env(shaderc::TargetEnv::Vulkan, shaderc::EnvVersion::Vulkan1_2 as u32);
        options.set_target_spirv(shaderc::SpirvVersion::V1_5);
        options.set_optimization_level(level);
        options.set_warnings_as_errors();
        for (name, value) in macros {
            options.add_macro_definition(name, Some(&value.to_string()));
        }
        let folder = source.path.parent().unwrap_or(Path::new("")).to_path_buf();
        options.set_include_callback(move |name, _, _, _| {
            let content = source::included(&folder, name)?;
            Ok(shaderc::ResolvedInclude { resolved_name: folder.join(name).display().to_string(), content })
        });
        let file = source.path.display().to_string();
        let kind = shaderc::ShaderKind::Compute;
        let artifact = self
            .shaderc
            .compile_into_spirv(&source.text, kind, &file, "main", Some(&options))
            .map_err(|e| match macros {
                [] => e.to_string(),
                _ => format!("{e}\n{file}: error: ... in the variant {macros:?}"),
            })?;
        // Written beside and renamed, so that an interrupted build leaves no half module in the
        // cache.
        let part = target.with_extension("part");
        std::fs::write(&part, artifact.as_binary_u8())
            .and_then(|()| std::fs::rename(&part, target))
            .map_err(|e| format!("{}: {e}", target.display()))
    }
}

fn read_words(path: &Path) -> Result<Vec<u32>, String> {
    let bytes = std::fs::read(path).map_err(|e| format!("{}: {e}", path.display()))?;
    Ok(bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect())
}

/// One module to be made.
struct Job {
    variant: Vec<u32>,
    subgroup_size: Option<u32>,
    float_atomics: Option<bool>,
    macros: Vec<(String, u32)>,
}

/// Every combination of variant, subgroup size and atomics.
fn jobs(source: &Source) -> Vec<Job> {
    let subgroups: Vec<Option<u32>> = match source.subgroups.as_slice() {
        [] => vec![None],
        sizes => sizes.iter().copied().map(Some).collect(),
    };
    let atomics: &[Option<bool>] = if source.float_atomics { &[Some(true), Some(false)] } else { &[None] };
    let mut jobs = Vec::new();
    for variant in product(&source.axes) {
        for &subgroup_size in &subgroups {
            for &float_atomics in atomics {
                let mut macros: Vec<(String, u32)> =
                    source.axes.iter().zip(&variant).map(|((n, _), &v)| (n.clone(), v)).collect();
                macros.extend(subgroup_size.map(|s| ("SUBGROUP_SIZE".to_owned(), s)));
                macros.extend(float_atomics.map(|f| ("FLOAT_ATOMICS".to_owned(), u32::from(f))));
                jobs.push(Job { variant: variant.clone(), subgroup_size, float_atomics, macros });
            }
        }
    }
    jobs
}

/// Cartesian product of the axes' values; one empty variant when there is no axis.
fn product(axes: &[(String, Vec<u32>)]) -> Vec<Vec<u32>> {
    axes.iter().fold(vec![Vec::new()], |done, (_, values)| {
        done.iter().flat_map(|head| values.iter().map(move |&v| [head.as_slice(), &[v]].concat())).collect()
    })
}
