//! Runs without a wait.
use super::{Program, Segment};
use crate::Result;
use crate::sync::lock;
use crate::transfer::Submitted;

/// A program that the device may still work on. Programs started one after the other run in that
/// order, each on the results of those before it.
///
/// Until [`Running::wait`], the host must not write what the program reads, and what it downloads
/// belongs to it: two programs that run at once download different buffers.
#[must_use]
pub struct Running {
    /// `None` only while dropping.
    program: Option<Program>,
    submitted: Option<Submitted>,
}

impl Program {
    /// Submits and does not wait. A program with native passes, which the host runs, is done when
    /// this returns.
    pub fn start(self) -> Result<Running> {
        let raw = lock(&self.raw);
        let submitted = match (raw.plain.as_slice(), self.executor()) {
            ([Segment::Device(commands)], None) => {
                self.forget_results();
                Some(self.device.send(*commands, raw.fence, &self.label)?)
            }
            _ => {
                self.submit(&raw.plain, raw.fence, &mut |_, _| ())?;
                None
            }
        };
        drop(raw);
        Ok(Running { program: Some(self), submitted })
    }
}

impl Running {
    /// Waits until the device is done, and returns the program.
    pub fn wait(mut self) -> Result<Program> {
        self.finish()?;
        self.program.take().ok_or_else(|| crate::Error::refused("a program was waited for twice"))
    }

    fn finish(&mut self) -> Result<()> {
        let (Some(program), Some(submitted)) = (&self.program, self.submitted.take()) else { return Ok(()) };
        program.device.wait(submitted, &program.label)?;
        program.note_results();
        Ok(())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // A device that is lost runs nothing any more.
        let _ = self.finish();
    }
}
