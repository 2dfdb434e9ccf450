//! Running programs elsewhere than on the device, for tests.
use crate::command::Op;

/// Executes the commands of a program on their buffers, which are mapped, instead of the device.
pub trait Executor: Send + Sync {
    /// Runs all commands of a program in order. The program returns an error with the text.
    fn run(&self, commands: &[&Op]) -> std::result::Result<(), String>;
}
