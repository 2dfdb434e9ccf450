//! Native code in place of shaders, where the device is the processor: a driver that interprets
//! shaders as vectors of lanes reads and writes every element by itself, and native code reads rows.
//!
//! A native pass does the work of every module of one [`Family`](crate::Family): the same buffers,
//! the same push constants, the same result up to rounding. It runs between the submissions of the
//! commands around it.
use crate::buffer::{Buffer, Mapped};
use crate::command::{Groups, Op};
use crate::{Error, Result};
use bytemuck::Pod;

/// Native code for the shaders of one family.
pub struct Native {
    /// [`Family::name`](crate::Family::name).
    pub family: &'static str,
    /// Does the work of one dispatch. An error is a mistake of the program, as a missing buffer is.
    pub run: fn(&mut NativeCall) -> std::result::Result<(), String>,
}

impl std::fmt::Debug for Native {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Native({})", self.family)
    }
}

/// A dispatch with the memory of its buffers.
pub struct NativeCall<'a> {
    variant: &'a [u32],
    push: &'a [u8],
    groups: [u32; 3],
    bound: Vec<(u32, Mapped<'a>)>,
}

impl NativeCall<'_> {
    /// Values of the family's axes.
    pub fn variant(&self) -> &[u32] {
        self.variant
    }

    /// Number of workgroups along each axis.
    pub fn groups(&self) -> [u32; 3] {
        self.groups
    }

    /// The first push constants, as words.
    ///
    /// # Errors
    /// With fewer of them.
    pub fn words<const N: usize>(&self) -> std::result::Result<[u32; N], String> {
        self.words_from(0)
    }

    /// Push constants as words, beginning with word `first`.
    ///
    /// # Errors
    /// With fewer of them.
    pub fn words_from<const N: usize>(&self, first: usize) -> std::result::Result<[u32; N], String> {
        let words: Vec<u32> =
            self.push.chunks_exact(4).map(|b| u32::from_ne_bytes([b[0], b[1], b[2], b[3]])).collect();
        let own = words.get(first..first + N).and_then(|w| w.try_into().ok());
        own.ok_or_else(|| format!("{} push constants expected", first + N))
    }

    /// The memory of the buffers with these binding numbers, each once.
    ///
    /// # Errors
    /// With a number that no buffer has.
    pub fn memory<const N: usize>(
        &mut self,
        numbers: [u32; N],
    ) -> std::result::Result<[Memory<'_>; N], String> {
        for number in numbers {
            if self.bound.iter().all(|(known, _)| *known != number) {
                return Err(format!("no buffer is bound to {number}"));
            }
        }
        Ok(self.optional(numbers))
    }

    /// [`NativeCall::memory`], empty for a buffer that this variant does not have.
    pub fn optional<const N: usize>(&mut self, numbers: [u32; N]) -> [Memory<'_>; N] {
        let mut found: [Memory; N] = std::array::from_fn(|_| Memory(&mut []));
        for (number, mapped) in &mut self.bound {
            if let Some(place) = numbers.iter().position(|n| n == number) {
                found[place] = Memory(mapped.bytes_mut());
            }
        }
        found
    }
}

/// The memory of one buffer.
pub struct Memory<'a>(&'a mut [u8]);

impl<'a> Memory<'a> {
    /// Its elements.
    pub fn of<T: Pod>(self) -> &'a mut [T] {
        // An empty slice has any address, also one that no `T` may have.
        match self.0.len() / size_of::<T>().max(1) * size_of::<T>() {
            0 => &mut [],
            whole => bytemuck::cast_slice_mut(&mut self.0[..whole]),
        }
    }
}

/// Runs a command natively; `natives` has one for every family that is dispatched.
pub(crate) fn run(natives: &[Native], op: &Op, label: &str) -> Result<()> {
    dispatched(natives, op).map_err(|e| Error::refused(format!("{label}: {e}")))
}

fn dispatched(natives: &[Native], op: &Op) -> std::result::Result<(), String> {
    match op {
        Op::Fill { buffer, value } => {
            let mut mapped = map(buffer)?;
            bytemuck::cast_slice_mut::<u8, u32>(mapped.bytes_mut()).fill(*value);
            Ok(())
        }
        Op::Copy { from, to, from_byte, to_byte, bytes } => {
            let (from_byte, to_byte, bytes) = (*from_byte as usize, *to_byte as usize, *bytes as usize);
            if from.id() == to.id() {
                map(from)?.bytes_mut().copy_within(from_byte..from_byte + bytes, to_byte);
                return Ok(());
            }
            let (mut from, mut to) = (map(from)?, map(to)?);
            to.bytes_mut()[to_byte..to_byte + bytes]
                .copy_from_slice(&from.bytes_mut()[from_byte..from_byte + bytes]);
            Ok(())
        }
        Op::Dispatch { module, call, groups } => {
            let native = find(natives, call.family.name).ok_or("no native code")?;
            let groups = match groups {
                Groups::Direct(groups) => *groups,
                Groups::Indirect { args, byte } => {
                    let mut mapped = map(args)?;
                    let at = *byte as usize;
                    let words: &[u32] = bytemuck::cast_slice(&mapped.bytes_mut()[at..at + 12]);
                    [words[0], words[1], words[2]]
                }
            };
            let used = call.buffers.iter().filter(|(n, _)| module.bindings.iter().any(|b| b.number == *n));
            let bound = used.map(|(n, buffer)| Ok((*n, map(buffer)?)));
            let bound = bound.collect::<std::result::Result<_, String>>()?;
            let mut call = NativeCall { variant: &call.variant, push: &call.push, groups, bound };
            (native.run)(&mut call)
        }
    }
}

/// The native code of a family.
pub(crate) fn find<'n>(natives: &'n [Native], family: &str) -> Option<&'n Native> {
    natives.iter().find(|native| native.family == family)
}

fn map(buffer: &Buffer) -> std::result::Result<Mapped<'_>, String> {
    buffer.mapped().ok_or_else(|| format!("`{}` is not mapped", buffer.name()))
}
