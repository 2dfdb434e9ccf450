//! Execution providers of ONNX Runtime: which device computes the networks. The CPU always can; a GPU does when the installed
//! library was built for it and answers.
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use ort::ep::{self, ExecutionProvider, ExecutionProviderDispatch};

use super::cache::{self, Key};
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

/// How networks are computed: by which provider, and whether their answers are kept. Clones share it; several in one process may
/// differ, except that they share the one loaded library.
#[derive(Clone)]
pub struct Compute(Arc<Shared>);

struct Shared {
    asked: String,
    cached: bool,
    chosen: OnceLock<Result<Option<&'static Provider>, String>>,
    notes: Mutex<Vec<String>>,
    turn: Mutex<()>,
}

impl fmt::Debug for Compute {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Compute({}, cached: {})", self.0.asked, self.0.cached)
    }
}

impl Default for Compute {
    fn default() -> Self {
        Compute::by(None)
    }
}

impl Compute {
    /// By one of [`NAMES`]; by default what `SPLATVK_PROVIDER` says, and without it `auto`.
    pub fn by(asked: Option<&str>) -> Compute {
        let variable = || std::env::var("SPLATVK_PROVIDER").ok().filter(|v| !v.is_empty());
        let asked = asked.map(str::to_owned).or_else(variable).unwrap_or_else(|| "auto".to_owned());
        Compute::new(asked, true)
    }

    fn new(asked: String, cached: bool) -> Compute {
        let (chosen, notes, turn) = Default::default();
        Compute(Arc::new(Shared { asked, cached, chosen, notes, turn }))
    }

    /// By the same provider, and everything is computed: what is measured must be.
    pub fn uncached(&self) -> Compute {
        Compute::new(self.0.asked.clone(), false)
    }

    /// `compute`, or what it gave the last time with the same key.
    pub(crate) fn remember(&self, key: Key, compute: impl FnOnce() -> Result<Vec<f32>>) -> Result<Vec<f32>> {
        if self.0.cached { cache::remember(key, compute) } else { compute() }
    }

    /// Held while a large network is loaded: stages that run beside each other take turns, so that a run needs the memory of
    /// one network and every network has all cores.
    pub(crate) fn turn(&self) -> MutexGuard<'_, ()> {
        self.0.turn.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The provider of new sessions, `None` for the CPU: found by computing a graph of one node on it. Asked for by name, one
    /// that does not answer is an error.
    pub(super) fn chosen(&self) -> Result<Option<&'static Provider>> {
        let found = || find(&self.0.asked, &mut |text| self.note(text));
        self.0.chosen.get_or_init(found).clone().map_err(Error::missing)
    }

    /// The name of what computes the networks.
    pub fn name(&self) -> Result<&'static str> {
        Ok(self.chosen()?.map_or("cpu", |p| p.name))
    }

    /// A network that the chosen provider refuses is computed by the CPU if nobody asked for the provider by name.
    pub(super) fn replaceable(&self) -> bool {
        self.0.asked == "auto"
    }

    pub(super) fn note(&self, text: String) {
        self.0.notes.lock().unwrap_or_else(PoisonError::into_inner).push(text);
    }

    /// Finds the provider, and returns what did not work since the last call, a sentence each.
    pub fn notes(&self) -> Result<Vec<String>> {
        self.chosen()?;
        Ok(std::mem::take(&mut *self.0.notes.lock().unwrap_or_else(PoisonError::into_inner)))
    }

    /// Warns of [`Compute::notes`].
    pub fn report(&self, progress: &dyn Progress) -> Result<()> {
        self.notes()?.iter().for_each(|n| progress.warn(n));
        Ok(())
    }
}

fn find(asked: &str, note: &mut dyn FnMut(String)) -> Result<Option<&'static Provider>, String> {
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
        let text = find(absent.name, &mut |_| ()).err().expect("it is not there");
        assert!(
            text.contains(absent.name) && text.contains("has only cpu") && text.contains("ORT_DYLIB_PATH"),
            "{text}"
        );
        assert!(find("cpu", &mut |_| ()).is_ok_and(|p| p.is_none()));
        assert!(find("gpu", &mut |_| ()).err().is_some_and(|e| e.contains("auto, cpu, cuda")));
    }

    #[test]
    fn two_in_one_process_differ() {
        let (cpu, absent) = (Compute::by(Some("cpu")), Compute::by(Some("gpu")));
        assert_eq!(cpu.name().unwrap(), "cpu");
        assert!(absent.name().unwrap_err().to_string().contains("auto, cpu, cuda"));
        // Answers are kept by one and not by the other.
        let key = || Key::new("test").text("two").values(&[std::process::id()]);
        let value = |compute: &Compute, v: f32| compute.remember(key(), || Ok(vec![v])).unwrap();
        assert_eq!(value(&cpu, 1.0), [1.0]);
        assert_eq!(value(&cpu, 2.0), [1.0]);
        assert_eq!(value(&cpu.uncached(), 3.0), [3.0]);
    }
}
