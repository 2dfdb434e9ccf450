//! Commands as plain data.
use crate::buffer::Buffer;
use crate::call::Call;
use crate::hazard::{self, AccessStage, BufferAccess};
use crate::module::Module;
use crate::{Error, Result};

/// The work of a command.
#[allow(missing_docs)] // named as the arguments of `Recorder`
pub enum Op {
    Fill { buffer: Buffer, value: u32 },
    Copy { from: Buffer, to: Buffer, from_byte: u64, to_byte: u64, bytes: u64 },
    Dispatch { module: &'static Module, call: Call, groups: Groups },
}

/// How many workgroups run.
#[allow(missing_docs)]
pub enum Groups {
    Direct([u32; 3]),
    Indirect { args: Buffer, byte: u64 },
}

pub(crate) struct Command {
    pub label: String,
    /// The pass it belongs to, see [`Recorder::pass`].
    pub pass: &'static str,
    pub op: Op,
}

impl Command {
    /// Declared accesses; for a dispatch they come from the compiled module.
    pub fn touches(&self) -> Vec<BufferAccess> {
        let touch = |b: &Buffer, stage, read, write| BufferAccess { buffer: b.id(), stage, read, write };
        match &self.op {
            Op::Fill { buffer, .. } => vec![touch(buffer, AccessStage::Transfer, false, true)],
            Op::Copy { from, to, .. } => {
                vec![
                    touch(from, AccessStage::Transfer, true, false),
                    touch(to, AccessStage::Transfer, false, true),
                ]
            }
            Op::Dispatch { module, call, groups } => {
                let mut touches = Vec::with_capacity(call.buffers.len() + 1);
                if let Groups::Indirect { args, .. } = groups {
                    touches.push(touch(args, AccessStage::Indirect, true, false));
                }
                for binding in module.bindings.iter().filter(|b| b.access.read || b.access.write) {
                    if let Some((_, buffer)) = call.buffers.iter().find(|(n, _)| *n == binding.number) {
                        touches.push(touch(
                            buffer,
                            AccessStage::Compute,
                            binding.access.read,
                            binding.access.write,
                        ));
                    }
                }
                touches
            }
        }
    }

    /// One of its buffers by identity.
    pub fn buffer(&self, id: u64) -> Option<&Buffer> {
        let (first, second, bound): (Option<&Buffer>, Option<&Buffer>, &[(u32, Buffer)]) = match &self.op {
            Op::Fill { buffer, .. } => (Some(buffer), None, &[]),
            Op::Copy { from, to, .. } => (Some(from), Some(to), &[]),
            Op::Dispatch { call, groups: Groups::Indirect { args, .. }, .. } => {
                (Some(args), None, &call.buffers)
            }
            Op::Dispatch { call, .. } => (None, None, &call.buffers),
        };
        first.into_iter().chain(second).chain(bound.iter().map(|(_, b)| b)).find(|b| b.id() == id)
    }
}

/// Refuses a command that touches one buffer twice with a write: the shader would see itself.
pub(crate) fn check_aliases(label: &str, commands: &[Command], touches: &[Vec<BufferAccess>]) -> Result<()> {
    for (command, touches) in commands.iter().zip(touches) {
        if let Some(id) = hazard::aliased(touches) {
            return Err(Error::refused(format!(
                "{label}: {} has buffer `{}` twice and writes to it",
                command.label,
                command.buffer(id).map_or("?", |b| b.name())
            )));
        }
    }
    Ok(())
}
