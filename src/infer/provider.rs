//! Execution providers of ONNX Runtime: which device computes the networks. The CPU always can; a GPU does when the installed
//! library was built for it and answers. The choice holds for the process, as the library does.
use std::sync::{Mutex, OnceLock, PoisonError};

use ort::ep::{self, ExecutionProvider, ExecutionProviderDispatch};

use super::runtime::{line, loaded, probe};
use crate::progress::Progress;
use crate::{Error, Result};

/// A way to compute networks other than on the CPU.
pub(super) struct Provider {
    /// What users write.
    name: &'static str,
    listed: fn() -> ort::Result<bool>,
    registration: fn() -> ExecutionProviderDispatch,
    /// `auto` takes it: where it answers, there is a GPU.
    automatic: bool,
}

impl Provider {
    const fn new<P: ExecutionProvider>(
        name: &'static str,
        automatic: bool,
        registration: fn() -> ExecutionProviderDispatch,
    ) -> Provider {
        Provider { name, listed: P::is_available, registration, automatic }
    }

    /// To be put before the CPU in a session; a session that cannot have it is refused, not made without it.
    pub(super) fn registration(&self) -> ExecutionProviderDispatch {
        (self.registration)().error_on_failure()
    }
}

/// Best first.
static PROVIDERS: [Provider; 7] = [
    // Shortened products (TF32) move keypoints by more than the poses are exact to.
    Provider::new::<ep::CUDA>("cuda", true, || ep::CUDA::default().with_tf32(false).build()),
    Provider::new::<ep::MIGraphX>("migraphx", true, || ep::MIGraphX::default().build()),
    Provider::new::<ep::ROCm>("rocm", true, || ep::ROCm::default().build()),
    Provider::new::<ep::DirectML>("directml", true, || ep::DirectML::default().build()),
    Provider::new::<ep::CoreML>("coreml", true, || ep::CoreML::default().build()),
    Provider::new::<ep::WebGPU>("webgpu", true, || ep::WebGPU::default().build()),
    // Answers everywhere, on a CPU no faster than the CPU's own way and with twice its memory.
    Provider::new::<ep::OpenVINO>("openvino", false, || ep::OpenVINO::default().build()),
];

/// What `--provider` and `SPLATVK_PROVIDER` take.
pub const NAMES: [&str; 9] =
    ["auto", "cpu", "cuda", "migraphx", "rocm", "directml", "coreml", "webgpu", "openvino"];

static ASKED: OnceLock<String> = OnceLock::new();
static CHOSEN: OnceLock<Result<Option<&'static Provider>, String>> = OnceLock::new();
static NOTES: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// Asks for one of [`NAMES`], before the first network is loaded; later calls change nothing. Unless this is called,
/// `SPLATVK_PROVIDER` decides, and without it `auto`.
pub fn choose(name: &str) {
    let _ = ASKED.set(name.to_owned());
}

fn asked() -> &'static str {
    let variable = || std::env::var("SPLATVK_PROVIDER").ok().filter(|v| !v.is_empty());
    ASKED.get_or_init(|| variable().unwrap_or_else(|| "auto".to_owned()))
}

/// The provider of new sessions, `None` for the CPU: found by computing a graph of one node on it. Asked for by name, one that
/// does not answer is an error.
pub(super) fn chosen() -> Result<Option<&'static Provider>> {
    CHOSEN.get_or_init(|| find(asked())).clone().map_err(Error::missing)
}

fn find(asked: &str) -> Result<Option<&'static Provider>, String> {
    let (library, environment) = loaded().map_err(|e| e.to_string())?;
    let library = library.display();
    let listed: Vec<&Provider> = PROVIDERS.iter().filter(|p| (p.listed)().unwrap_or(false)).collect();
    match asked {
        "cpu" => Ok(None),
        "auto" => {
            for provider in listed.into_iter().filter(|p| p.automatic) {
                match probe(environment, Some(provider)) {
                    Ok(()) => return Ok(Some(provider)),
                    Err(e) => note(format!(
                        "{library} has {} but cannot use it ({}); the CPU computes the networks",
                        provider.name,
                        reason(&e)
                    )),
                }
            }
            Ok(None)
        }
        name if !NAMES.contains(&name) => {
            Err(format!("provider {name}: unknown; choose one of {}", NAMES.join(", ")))
        }
        name => match listed.iter().find(|p| p.name == name) {
            Some(provider) => probe(environment, Some(provider)).map(|()| Some(*provider)).map_err(|e| {
                format!(
                    "provider {name}: {library} cannot use it ({}); mend that, or take --provider cpu",
                    reason(&e)
                )
            }),
            None => {
                let has: Vec<&str> = std::iter::once("cpu").chain(listed.iter().map(|p| p.name)).collect();
                Err(format!(
                    "provider {name}: {library} has only {}; set ORT_DYLIB_PATH to a build of ONNX Runtime with {name}",
                    has.join(", ")
                ))
            }
        },
    }
}

/// What went wrong, without the place in ONNX Runtime's source that precedes it.
fn reason(error: &ort::Error) -> String {
    let text = line(error);
    [" was false. ", " FAIL : "]
        .iter()
        .fold(text.as_str(), |t, mark| t.rsplit(mark).next().unwrap_or(t))
        .to_owned()
}

/// The name of what computes the networks.
pub fn name() -> Result<&'static str> {
    Ok(chosen()?.map_or("cpu", |p| p.name))
}

/// A network that the chosen provider refuses is computed by the CPU if nobody asked for the provider by name.
pub(super) fn replaceable() -> bool {
    asked() == "auto"
}

pub(super) fn note(text: String) {
    NOTES.lock().unwrap_or_else(PoisonError::into_inner).push(text);
}

/// Finds the provider, and returns what did not work since the last call, a sentence each.
pub fn notes() -> Result<Vec<String>> {
    chosen()?;
    Ok(std::mem::take(&mut *NOTES.lock().unwrap_or_else(PoisonError::into_inner)))
}

/// Warns of [`notes`].
pub fn report(progress: &dyn Progress) -> Result<()> {
    notes()?.iter().for_each(|n| progress.warn(n));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_is_a_provider_or_a_rule() {
        let names: Vec<&str> = ["auto", "cpu"].into_iter().chain(PROVIDERS.iter().map(|p| p.name)).collect();
        assert_eq!(names, NAMES);
    }

    #[test]
    fn the_cpu_computes_the_probe() {
        probe(&loaded().expect("tools/setup").1, None).expect("one node");
    }

    #[test]
    fn what_the_library_lacks_is_refused_with_what_it_has() {
        loaded().expect("tools/setup");
        // The default pack's library is a CPU build; a tester's own may not be.
        let absent =
            PROVIDERS.iter().find(|p| !(p.listed)().unwrap_or(false)).expect("no build has them all");
        let text = find(absent.name).err().expect("it is not there");
        assert!(
            text.contains(absent.name) && text.contains("has only cpu") && text.contains("ORT_DYLIB_PATH"),
            "{text}"
        );
        assert!(find("cpu").is_ok_and(|p| p.is_none()));
        assert!(find("gpu").err().is_some_and(|e| e.contains("auto, cpu, cuda")));
    }
}
