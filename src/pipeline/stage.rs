//! Interface of a stage.
use super::output::Inputs;
use super::store::Codec;
use crate::Result;
use crate::gpu::Device;
use crate::infer::Registry;
use crate::progress::Progress;

/// Environment of a running stage.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    /// Device for all GPU work.
    pub device: &'a Device,
    /// Registry of models.
    pub registry: &'a Registry,
    /// Receives reports of the stage and carries requests to stop.
    pub progress: &'a dyn Progress,
}

/// Resource that a stage keeps busy. One stage per lane runs at a time: two on one device would
/// only wait for each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Lane {
    /// The Vulkan device, and the processor while cameras are found, for which all other stages
    /// wait.
    Device,
    /// The processor: masks, features, words.
    Processor,
}

/// One step of the work, with its settings.
pub trait Stage: Send {
    /// Name in error messages and in the store.
    const NAME: &'static str;
    /// Resource that it keeps busy.
    const LANE: Lane;
    /// Outputs of other stages, a tuple of [`super::Output`]s.
    type Inputs: Inputs;
    /// Type of its output.
    type Output: Send + Sync + 'static;

    /// Dependencies of the output besides the inputs, the program, the provider of networks and, on
    /// [`Lane::Device`], the device: options, seeds, checksums of models and files.
    fn settings(&self) -> String;

    /// Codec of the output on disk; `None` where computing it again is faster than reading it.
    fn codec() -> Option<Codec<Self::Output>> {
        None
    }

    /// Does the work; begins and ends its own steps of progress.
    fn run(self, inputs: <Self::Inputs as Inputs>::Values<'_>, context: &Context) -> Result<Self::Output>;
}
