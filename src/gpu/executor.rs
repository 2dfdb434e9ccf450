//! Running a program somewhere else than on the device, for tests.
use super::command::Op;

/// Takes the place of the device: does what the commands of a program say to their buffers, which are mapped. For tests
/// only, see tests/spirv.
#[doc(hidden)]
pub trait Executor: Send + Sync {
    /// All commands of a program in order; what went wrong, for the error that the program returns.
    fn run(&self, commands: &[&Op]) -> std::result::Result<(), String>;
}

/// How a device keeps its executor.
pub(super) type Attached = Box<dyn Executor>;
