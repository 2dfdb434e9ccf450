//! Execution providers of ONNX Runtime. The CPU is always available, a GPU if the installed library
//! was built for it and a test graph runs on it.
#[cfg(feature = "networks")]
use ort::ep;
use ort::ep::ExecutionProviderDispatch;

use super::library::{line, loaded};
use ort::environment::Environment;
use ort::session::builder::{GraphOptimizationLevel, SessionBuilder};
use ort::value::Tensor as OrtTensor;

/// An execution provider other than the CPU.
pub(super) struct Provider {
    /// Name in options.
    pub(super) name: &'static str,
    listed: fn() -> ort::Result<bool>,
    registration: fn() -> ExecutionProviderDispatch,
    /// Whether `auto` selects it: only providers that need a GPU.
    automatic: bool,
}

impl Provider {
    #[cfg(feature = "networks")]
    const fn new<P: ep::ExecutionProvider>(
        name: &'static str,
        automatic: bool,
        registration: fn() -> ExecutionProviderDispatch,
    ) -> Provider {
        Provider { name, listed: P::is_available, registration, automatic }
    }

    /// Registration before the CPU; a session without the provider is an error.
    pub(super) fn registration(&self) -> ExecutionProviderDispatch {
        (self.registration)().error_on_failure()
    }
}

/// Best first.
#[cfg(feature = "networks")]
static PROVIDERS: &[Provider] = &[
    // TF32 products move keypoints by more than the accuracy of the poses.
    Provider::new::<ep::CUDA>("cuda", true, || ep::CUDA::default().with_tf32(false).build()),
    Provider::new::<ep::MIGraphX>("migraphx", true, || ep::MIGraphX::default().build()),
    Provider::new::<ep::ROCm>("rocm", true, || ep::ROCm::default().build()),
    Provider::new::<ep::DirectML>("directml", true, || ep::DirectML::default().build()),
    Provider::new::<ep::CoreML>("coreml", true, || ep::CoreML::default().build()),
    Provider::new::<ep::WebGPU>("webgpu", true, || ep::WebGPU::default().build()),
    // Also runs on a CPU, no faster than ONNX Runtime's CPU provider and with twice its memory.
    Provider::new::<ep::OpenVINO>("openvino", false, || ep::OpenVINO::default().build()),
];

#[cfg(not(feature = "networks"))]
static PROVIDERS: &[Provider] = &[];

/// Values of `--provider` and `SPLATVK_PROVIDER`.
pub const NAMES: [&str; 9] =
    ["auto", "cpu", "cuda", "migraphx", "rocm", "directml", "coreml", "webgpu", "openvino"];

/// Finds the requested provider and tests it with a graph of one node.
pub(super) fn find(
    requested: &str,
    note: &mut dyn FnMut(String),
) -> Result<Option<&'static Provider>, String> {
    let (library, environment) = loaded().map_err(|e| e.to_string())?;
    let library = library.display();
    let listed: Vec<&Provider> = PROVIDERS.iter().filter(|p| (p.listed)().unwrap_or(false)).collect();
    match requested {
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

/// Message of an error, without the location in ONNX Runtime's source before it.
fn reason(error: &ort::Error) -> String {
    let text = line(error);
    [" was false. ", " FAIL : "]
        .iter()
        .fold(text.as_str(), |t, mark| t.rsplit(mark).next().unwrap_or(t))
        .to_owned()
}

/// Settings of sessions.
pub(super) fn settings(
    environment: &Environment,
    provider: Option<&Provider>,
    large: bool,
) -> ort::Result<SessionBuilder> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let builder = ort::session::Session::builder(environment)?
        .with_optimization_level(GraphOptimizationLevel::Level3)?
        .with_intra_threads(threads)?
        // Spinning threads would keep all cores busy, which passes on the CPU and other sessions
        // need.
        .with_intra_op_spinning(false)?;
    let mut providers: Vec<_> = provider.iter().map(|p| p.registration()).collect();
    if large {
        // The arena doubles its memory and keeps it until the session ends.
        providers.push(ort::ep::CPU::default().with_arena_allocator(false).build());
    }
    // DirectML does not support memory patterns.
    Ok(builder.with_memory_pattern(!large && provider.is_none())?.with_execution_providers(providers)?)
}

/// y = Relu(x) of one float, as an ONNX file: a sequence of (field and kind, length, content).
const PROBE: &[u8] = b"\x08\x08\x3a\x33\
    \x0a\x0c\x0a\x01x\x12\x01y\x22\x04Relu\x12\x01g\
    \x5a\x0f\x0a\x01x\x12\x0a\x0a\x08\x08\x01\x12\x04\x0a\x02\x08\x01\
    \x62\x0f\x0a\x01y\x12\x0a\x0a\x08\x08\x01\x12\x04\x0a\x02\x08\x01\
    \x42\x04\x0a\x00\x10\x11";

/// Runs a graph of one node: a library may list and even register a provider on a machine without
/// its device.
fn probe(environment: &Environment, provider: Option<&Provider>) -> ort::Result<()> {
    let mut session = settings(environment, provider, false)?.commit_from_memory(PROBE)?;
    let computed = session.run(ort::inputs!["x" => OrtTensor::from_array(([1usize], vec![2f32]))?])?;
    match computed["y"].try_extract_tensor::<f32>()?.1 {
        [2.0] => Ok(()),
        other => Err(ort::Error::new(format!("it computes max(2, 0) = {other:?}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(feature = "networks")]
    #[test]
    fn names_list_every_provider() {
        let names: Vec<&str> = ["auto", "cpu"].into_iter().chain(PROVIDERS.iter().map(|p| p.name)).collect();
        assert_eq!(names, NAMES);
    }

    #[test]
    fn probe_runs_on_cpu() {
        probe(&loaded().expect("tools/setup").1, None).expect("one node");
    }

    #[cfg(feature = "networks")]
    #[test]
    fn find_absent_provider_is_refused() {
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
}
