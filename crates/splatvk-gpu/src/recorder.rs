//! Collecting commands.
use crate::buffer::Buffer;
use crate::call::Call;
use crate::command::{Command, Groups, Op};
use crate::device::Device;
use crate::module::Module;
use crate::program::Program;
use crate::{Error, Result};

/// Collects commands; barriers are derived from the access of the shaders when it is
/// compiled or run. Recording never fails: the first mistake is kept and returned by
/// [`Recorder::compile`] and [`Recorder::run`].
pub struct Recorder {
    device: Device,
    label: String,
    pass: &'static str,
    commands: Vec<Command>,
    error: Option<Error>,
}

impl Recorder {
    /// An empty recording; the label appears in errors.
    pub fn new(device: &Device, label: &str) -> Recorder {
        Recorder {
            device: device.clone(),
            label: label.to_owned(),
            pass: "other",
            commands: Vec::new(),
            error: None,
        }
    }

    /// Names the pass that the commands from here on belong to: [`Program::passes`].
    pub fn pass(&mut self, name: &'static str) {
        self.pass = name;
    }

    /// Sets every 32-bit word of the buffer.
    pub fn fill<T>(&mut self, buffer: &Buffer<T>, value: u32) {
        let buffer = buffer.cast();
        self.own(&[&buffer]);
        let op = Op::Fill { buffer: buffer.clone(), value };
        self.push(format!("fill {}", buffer.name()), op);
    }

    /// Copies a whole buffer onto the start of one that is at least as long.
    pub fn copy<T, U>(&mut self, from: &Buffer<T>, to: &Buffer<U>) {
        self.copy_bytes(from, 0, to, 0, from.bytes());
    }

    /// Copies `bytes` bytes from one offset to another; offsets are in bytes.
    pub fn copy_bytes<T, U>(
        &mut self,
        from: &Buffer<T>,
        from_byte: u64,
        to: &Buffer<U>,
        to_byte: u64,
        bytes: u64,
    ) {
        let (from, to) = (from.cast(), to.cast());
        self.own(&[&from, &to]);
        let label = format!("copy {} to {}", from.name(), to.name());
        if from_byte.saturating_add(bytes) > from.bytes() || to_byte.saturating_add(bytes) > to.bytes() {
            self.fail(format!("{label}: {bytes} bytes from {from_byte} to {to_byte} reach beyond the end"));
        } else if bytes > 0 {
            let op = Op::Copy { from, to, from_byte, to_byte, bytes };
            self.push(label, op);
        }
    }

    /// Brings a buffer to the host with the same submission: until something writes it again,
    /// [`Buffer::read`] returns what it holds here without another one. For small results that
    /// every run is asked for; the copy in mapped memory stays as long as the buffer. Nothing where
    /// buffers are mapped.
    pub fn download<T>(&mut self, buffer: &Buffer<T>) {
        if self.device.info().mapped {
            return;
        }
        match buffer.host_copy() {
            Ok(copy) => self.copy(buffer, copy),
            Err(e) => self.fail_with(e),
        }
    }

    /// Runs `groups` workgroups; nothing when one of the counts is 0.
    pub fn dispatch(&mut self, call: Call, groups: [u32; 3]) {
        if let Some(module) = self.resolve(&call) {
            self.push_dispatch(module, call, groups);
        }
    }

    /// Runs enough workgroups for this many threads per axis; shaders guard the overhang.
    pub fn dispatch_threads(&mut self, call: Call, threads: [u32; 3]) {
        if let Some(module) = self.resolve(&call) {
            let size = module.workgroup;
            let groups = [0, 1, 2].map(|i| threads[i].div_ceil(size[i].max(1)));
            self.push_dispatch(module, call, groups);
        }
    }

    /// Takes the three `u32` group counts from `args` at a byte offset, when the device gets there.
    pub fn dispatch_indirect(&mut self, call: Call, args: &Buffer, byte: u64) {
        self.own(&[args]);
        if !byte.is_multiple_of(4) || byte.saturating_add(12) > args.bytes() {
            self.fail(format!("indirect arguments at byte {byte} of `{}` are misplaced", args.name()));
        }
        if let Some(module) = self.resolve(&call) {
            let groups = Groups::Indirect { args: args.clone(), byte };
            self.push(module.name.to_owned(), Op::Dispatch { module, call, groups });
        }
    }

    /// The device that will run it.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Number of commands so far.
    pub fn len(&self) -> usize {
        self.commands.len()
    }

    /// Whether nothing was recorded.
    pub fn is_empty(&self) -> bool {
        self.commands.is_empty()
    }

    /// Submits once and waits.
    pub fn run(self) -> Result<()> {
        self.compile()?.run()
    }

    /// Submits once and waits; milliseconds per command, in order. The first run of a shader
    /// includes the driver's own compilation, so warm up before timing.
    pub fn run_timed(self) -> Result<Vec<(String, f64)>> {
        self.compile()?.run_timed()
    }

    /// Derives and checks the barriers and encodes the commands for repeated runs.
    pub fn compile(self) -> Result<Program> {
        match self.error {
            Some(e) => Err(e),
            None => Program::new(self.device, self.label, self.commands),
        }
    }

    /// One program per pass, to be run in order: slower than the whole, but the host can look at
    /// its clocks in between.
    pub fn compile_passes(self) -> Result<Vec<(&'static str, Program)>> {
        if let Some(e) = self.error {
            return Err(e);
        }
        let mut passes: Vec<(&'static str, Vec<Command>)> = Vec::new();
        for command in self.commands {
            match passes.last_mut().filter(|p| p.0 == command.pass) {
                Some(pass) => pass.1.push(command),
                None => passes.push((command.pass, vec![command])),
            }
        }
        let program =
            |(name, commands)| Ok((name, Program::new(self.device.clone(), self.label.clone(), commands)?));
        passes.into_iter().map(program).collect()
    }

    /// All commands without barriers, to test that the validation layer reports missing ones.
    #[cfg(test)]
    pub(crate) fn compile_without_barriers(self) -> Result<Program> {
        let steps = (0..self.commands.len()).map(crate::hazard::Step::Command).collect();
        Program::assemble(self.device, self.label, self.commands, steps)
    }

    fn push(&mut self, label: String, op: Op) {
        self.commands.push(Command { label, pass: self.pass, op });
    }

    fn push_dispatch(&mut self, module: &'static Module, call: Call, groups: [u32; 3]) {
        let most = self.device.info().max_groups;
        if (0..3).any(|i| groups[i] > most[i]) {
            self.fail(format!("{}: {groups:?} workgroups, the device allows {most:?}", module.name));
        } else if groups.iter().all(|&g| g > 0) {
            let groups = Groups::Direct(groups);
            self.push(module.name.to_owned(), Op::Dispatch { module, call, groups });
        }
    }

    fn resolve(&mut self, call: &Call) -> Option<&'static Module> {
        let buffers: Vec<&Buffer> = call.buffers.iter().map(|(_, b)| b).collect();
        self.own(&buffers);
        match call.resolve(self.device.info()) {
            Ok(module) => Some(module),
            Err(e) => {
                self.fail_with(e);
                None
            }
        }
    }

    fn own(&mut self, buffers: &[&Buffer]) {
        if let Some(stranger) = buffers.iter().find(|b| !b.belongs_to(&self.device)) {
            self.fail(format!("buffer `{}` belongs to another device", stranger.name()));
        }
    }

    /// Keeps a mistake for [`Recorder::compile`] to return, unless there is an earlier one.
    pub fn fail(&mut self, what: impl std::fmt::Display) {
        let message = format!("{}: {what}", self.label);
        self.fail_with(Error::refused(message));
    }

    /// [`Recorder::fail`] with an error that a program may react to, such as a device without
    /// memory.
    pub fn fail_with(&mut self, error: Error) {
        self.error.get_or_insert(error);
    }
}
