//! The interface of a stage.
use super::output::Inputs;
use super::store::Codec;
use crate::Result;
use crate::gpu::Device;
use crate::infer::Registry;
use crate::progress::Progress;

/// What a stage works with besides its inputs.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    /// The device of everything that computes on one.
    pub device: &'a Device,
    /// Where models are found.
    pub registry: &'a Registry,
    /// Where the stage reports, and learns that it should stop.
    pub progress: &'a dyn Progress,
}

/// What a stage keeps busy. One stage of each kind runs at a time: two on one device would only
/// wait for each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Lane {
    /// The Vulkan device, and the processor where cameras are found: what everything else waits
    /// for.
    Device,
    /// The processor: masks, features, words.
    Processor,
}

/// One step of the work, with its settings.
pub trait Stage: Send {
    /// As error messages and the store call it.
    const NAME: &'static str;
    /// What it keeps busy.
    const LANE: Lane;
    /// Outputs of other stages, a tuple of [`super::Output`]s.
    type Inputs: Inputs;
    /// What it makes.
    type Output: Send + Sync + 'static;

    /// Everything that the output depends on besides the inputs, the program, what computes
    /// networks and, on the device's lane, the device: options, seeds, checksums of models and
    /// files.
    fn settings(&self) -> String;

    /// How the output is kept on disk; `None` for what is made again sooner than read.
    fn codec() -> Option<Codec<Self::Output>> {
        None
    }

    /// Does the work. It begins and ends its own steps of progress.
    fn run(self, inputs: <Self::Inputs as Inputs>::Values<'_>, context: &Context) -> Result<Self::Output>;
}
