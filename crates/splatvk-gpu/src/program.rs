//! A compiled recording: command buffers that can be submitted again and again.
use crate::barrier;
use crate::buffer::Buffer;
use crate::call::Call;
use crate::command::{self, Command, Groups, Op};
use crate::device::Device;
use crate::error::vk_error;
use crate::executor::Executor;
use crate::hazard::{self, Barrier, Step};
use crate::module::Module;
use crate::sync::lock;
use crate::{Error, Result};
use ash::vk;
use std::collections::HashMap;
use std::sync::Mutex;

/// A recording ready to run, any number of times. It keeps its buffers alive.
pub struct Program {
    device: Device,
    label: String,
    commands: Vec<Command>,
    steps: Vec<Step>,
    /// Buffers it writes, and whether it copies their final content to the host.
    results: Vec<(Buffer, bool)>,
    /// Runs of one program exclude each other: the command buffers are not for simultaneous use.
    raw: Mutex<Raw>,
}

struct Raw {
    pool: vk::CommandPool,
    descriptors: vk::DescriptorPool,
    sets: Vec<vk::DescriptorSet>,
    fence: vk::Fence,
    plain: vk::CommandBuffer,
    /// With timestamps; encoded when first asked for.
    timed: Option<(vk::CommandBuffer, vk::QueryPool)>,
}

impl Program {
    pub(crate) fn new(device: Device, label: String, commands: Vec<Command>) -> Result<Program> {
        let touches: Vec<_> = commands.iter().map(Command::touches).collect();
        command::check_aliases(&label, &commands, &touches)?;
        let steps = hazard::derive(&touches);
        if let Some(h) = hazard::check(&touches, &steps).first() {
            let name = commands[h.later].buffer(h.buffer).map_or("?", |b| b.name());
            let (earlier, later) = (&commands[h.earlier].label, &commands[h.later].label);
            return Err(Error::refused(format!(
                "{label}: {} on `{name}` between {earlier} and {later} has no barrier (a bug in gpu::hazard)",
                h.kind
            )));
        }
        Self::assemble(device, label, commands, steps)
    }

    /// Encodes a final list; [`Program::new`] has checked it.
    pub(crate) fn assemble(
        device: Device,
        label: String,
        commands: Vec<Command>,
        steps: Vec<Step>,
    ) -> Result<Program> {
        let raw = Raw {
            pool: vk::CommandPool::null(),
            descriptors: vk::DescriptorPool::null(),
            sets: Vec::new(),
            fence: vk::Fence::null(),
            plain: vk::CommandBuffer::null(),
            timed: None,
        };
        let results = results(&commands);
        let program = Program { device, label, commands, steps, results, raw: Mutex::new(raw) };
        if program.executor().is_none() {
            // From here on Drop cleans up whatever has been made.
            program.prepare()?;
        }
        Ok(program)
    }

    /// Submits and waits.
    pub fn run(&self) -> Result<()> {
        let raw = lock(&self.raw);
        self.submit(raw.plain, raw.fence)
    }

    /// The executor that replaces the device, in tests.
    fn executor(&self) -> Option<&dyn Executor> {
        self.device.0.stand_in.as_deref()
    }

    fn submit(&self, commands: vk::CommandBuffer, fence: vk::Fence) -> Result<()> {
        if let Some(executor) = self.executor() {
            let commands: Vec<&Op> = self.commands.iter().map(|c| &c.op).collect();
            return executor.run(&commands).map_err(|e| Error::refused(format!("{}: {e}", self.label)));
        }
        self.results.iter().for_each(|(buffer, _)| buffer.set_fetched(false));
        self.device.submit(commands, fence, &self.label)?;
        self.results.iter().for_each(|(buffer, fetched)| buffer.set_fetched(*fetched));
        Ok(())
    }

    /// Submits and waits; milliseconds per command, in order.
    pub fn run_timed(&self) -> Result<Vec<(String, f64)>> {
        let period = self.device.info().timestamp_period;
        if period == 0.0 {
            return Err(Error::refused(format!("{} has no timestamps", self.device.info().name)));
        }
        let mut raw = lock(&self.raw);
        let (commands, pool) = match raw.timed {
            Some(timed) => timed,
            None => {
                let timed = self.encode_timed(&raw)?;
                raw.timed = Some(timed);
                timed
            }
        };
        self.submit(commands, raw.fence)?;
        let mut ticks = vec![0u64; 2 * self.commands.len()];
        if !ticks.is_empty() {
            let flags = vk::QueryResultFlags::TYPE_64 | vk::QueryResultFlags::WAIT;
            // SAFETY: the pool has two queries per command, all written by the finished submit.
            unsafe { self.device.0.device.get_query_pool_results(pool, 0, &mut ticks, flags) }
                .map_err(vk_error(&self.label))?;
        }
        let ms = |pair: &[u64]| pair[1].saturating_sub(pair[0]) as f64 * period / 1e6;
        Ok(self.commands.iter().zip(ticks.chunks_exact(2)).map(|(c, t)| (c.label.clone(), ms(t))).collect())
    }

    /// The pass of each command (see [`crate::Recorder::pass`]), in order.
    pub fn passes(&self) -> impl Iterator<Item = &'static str> {
        self.commands.iter().map(|c| c.pass)
    }

    /// Number of commands and of barriers between them, for tests and reports.
    pub fn counts(&self) -> (usize, usize) {
        let barriers = self.steps.iter().filter(|s| matches!(s, Step::Barriers(_))).count();
        (self.commands.len(), barriers)
    }

    fn prepare(&self) -> Result<()> {
        let device = &self.device.0.device;
        let mut raw = lock(&self.raw);
        let pool = vk::CommandPoolCreateInfo::default().queue_family_index(self.device.0.queue_family);
        // SAFETY: plain object creation on a live device.
        unsafe {
            raw.pool = device.create_command_pool(&pool, None).map_err(vk_error(&self.label))?;
            raw.fence =
                device.create_fence(&vk::FenceCreateInfo::default(), None).map_err(vk_error(&self.label))?;
        }
        self.descriptors(&mut raw)?;
        raw.plain = self.begin(&raw)?;
        self.encode(&raw, raw.plain, None)
    }

    fn begin(&self, raw: &Raw) -> Result<vk::CommandBuffer> {
        let device = &self.device.0.device;
        let info = vk::CommandBufferAllocateInfo::default().command_pool(raw.pool).command_buffer_count(1);
        // SAFETY: the pool is alive and guarded by the lock on `raw`.
        let buffers = unsafe { device.allocate_command_buffers(&info) }.map_err(vk_error(&self.label))?;
        let commands = buffers.first().copied().unwrap_or_default();
        // SAFETY: freshly allocated.
        unsafe { device.begin_command_buffer(commands, &vk::CommandBufferBeginInfo::default()) }
            .map_err(vk_error(&self.label))?;
        Ok(commands)
    }

    /// One descriptor set per distinct pair of module and buffers, in `raw.sets` by command.
    fn descriptors(&self, raw: &mut Raw) -> Result<()> {
        let device = &self.device.0.device;
        type Key = (&'static str, Vec<u64>);
        let mut distinct: Vec<(&'static Module, &Call)> = Vec::new();
        let mut index: HashMap<Key, usize> = HashMap::new();
        let mut by_command = Vec::with_capacity(self.commands.len());
        for command in &self.commands {
            let Op::Dispatch { module, call, .. } = &command.op else {
                by_command.push(None);
                continue;
            };
            let key = (module.name, call.buffers.iter().map(|(_, b)| b.id()).collect());
            let slot = *index.entry(key).or_insert_with(|| {
                distinct.push((module, call));
                distinct.len() - 1
            });
            by_command.push(Some(slot));
        }
        let mut sets = Vec::with_capacity(distinct.len());
        if !distinct.is_empty() {
            let count: usize = distinct.iter().map(|(m, _)| m.bindings.len()).sum();
            let sizes = [vk::DescriptorPoolSize::default()
                .ty(vk::DescriptorType::STORAGE_BUFFER)
                .descriptor_count(count.max(1) as u32)];
            let info =
                vk::DescriptorPoolCreateInfo::default().max_sets(distinct.len() as u32).pool_sizes(&sizes);
            // SAFETY: plain object creation on a live device.
            raw.descriptors =
                unsafe { device.create_descriptor_pool(&info, None) }.map_err(vk_error(&self.label))?;
        }
        for (module, call) in distinct {
            sets.push(self.descriptor_set(raw.descriptors, module, call)?);
        }
        raw.sets = by_command.into_iter().map(|slot| slot.map(|s| sets[s]).unwrap_or_default()).collect();
        Ok(())
    }

    fn descriptor_set(
        &self,
        pool: vk::DescriptorPool,
        module: &'static Module,
        call: &Call,
    ) -> Result<vk::DescriptorSet> {
        let device = &self.device.0.device;
        let layouts = [self.device.pipeline(module)?.set_layout];
        let info = vk::DescriptorSetAllocateInfo::default().descriptor_pool(pool).set_layouts(&layouts);
        // SAFETY: pool and layout are alive; the pool was sized for all sets.
        let sets = unsafe { device.allocate_descriptor_sets(&info) }.map_err(vk_error(&self.label))?;
        let set = sets.first().copied().unwrap_or_default();
        let mut buffers = Vec::with_capacity(module.bindings.len());
        for binding in module.bindings {
            let (_, buffer) = call.buffers.iter().find(|(n, _)| *n == binding.number).ok_or_else(|| {
                Error::refused(format!("{}: {} misses `{}`", self.label, module.name, binding.name))
            })?;
            buffers
                .push([vk::DescriptorBufferInfo::default().buffer(buffer.raw()).range(buffer.raw_bytes())]);
        }
        let writes: Vec<_> = module
            .bindings
            .iter()
            .zip(&buffers)
            .map(|(binding, info)| {
                vk::WriteDescriptorSet::default()
                    .dst_set(set)
                    .dst_binding(binding.number)
                    .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                    .buffer_info(info)
            })
            .collect();
        // SAFETY: the set is not in use yet; the buffers are kept alive by `self.commands`.
        unsafe { device.update_descriptor_sets(&writes, &[]) };
        Ok(set)
    }

    fn encode_timed(&self, raw: &Raw) -> Result<(vk::CommandBuffer, vk::QueryPool)> {
        let device = &self.device.0.device;
        let count = (2 * self.commands.len()).max(1) as u32;
        let info = vk::QueryPoolCreateInfo::default().query_type(vk::QueryType::TIMESTAMP).query_count(count);
        // SAFETY: plain object creation on a live device.
        let queries = unsafe { device.create_query_pool(&info, None) }.map_err(vk_error(&self.label))?;
        let encode = || {
            let commands = self.begin(raw)?;
            // SAFETY: recording; the pool has `count` queries.
            unsafe { device.cmd_reset_query_pool(commands, queries, 0, count) };
            self.encode(raw, commands, Some(queries))?;
            Ok(commands)
        };
        encode().map(|commands| (commands, queries)).inspect_err(|_| {
            // SAFETY: never submitted.
            unsafe { device.destroy_query_pool(queries, None) }
        })
    }

    /// Records all steps into a command buffer that has begun, and ends it.
    fn encode(&self, raw: &Raw, out: vk::CommandBuffer, queries: Option<vk::QueryPool>) -> Result<()> {
        let device = &self.device.0.device;
        let stamp = |index: usize| {
            if let Some(pool) = queries {
                let stage = vk::PipelineStageFlags::BOTTOM_OF_PIPE;
                // SAFETY: recording; `index` lies in the pool.
                unsafe { device.cmd_write_timestamp(out, stage, pool, index as u32) };
            }
        };
        self.device.cmd_edge_barrier(out);
        for step in &self.steps {
            match step {
                Step::Barriers(barriers) => self.encode_barriers(out, barriers),
                Step::Command(index) => {
                    stamp(2 * index);
                    self.encode_command(out, &self.commands[*index], raw.sets[*index])?;
                    stamp(2 * index + 1);
                }
            }
        }
        self.device.cmd_edge_barrier(out);
        // SAFETY: recording.
        unsafe { device.end_command_buffer(out) }.map_err(vk_error(&self.label))
    }

    fn encode_command(
        &self,
        out: vk::CommandBuffer,
        command: &Command,
        set: vk::DescriptorSet,
    ) -> Result<()> {
        let device = &self.device.0.device;
        // SAFETY: recording; offsets and sizes were checked by the recorder, and all objects live
        // as long as `self`.
        unsafe {
            match &command.op {
                Op::Fill { buffer, value } => {
                    device.cmd_fill_buffer(out, buffer.raw(), 0, buffer.raw_bytes(), *value);
                }
                Op::Copy { from, to, from_byte, to_byte, bytes } => {
                    let region =
                        [vk::BufferCopy { src_offset: *from_byte, dst_offset: *to_byte, size: *bytes }];
                    device.cmd_copy_buffer(out, from.raw(), to.raw(), &region);
                }
                Op::Dispatch { module, call, groups } => {
                    let pipeline = self.device.pipeline(module)?;
                    let point = vk::PipelineBindPoint::COMPUTE;
                    device.cmd_bind_pipeline(out, point, pipeline.raw);
                    device.cmd_bind_descriptor_sets(out, point, pipeline.layout, 0, &[set], &[]);
                    if !call.push.is_empty() {
                        let stage = vk::ShaderStageFlags::COMPUTE;
                        device.cmd_push_constants(out, pipeline.layout, stage, 0, &call.push);
                    }
                    match groups {
                        Groups::Direct([x, y, z]) => device.cmd_dispatch(out, *x, *y, *z),
                        Groups::Indirect { args, byte } => {
                            device.cmd_dispatch_indirect(out, args.raw(), *byte)
                        }
                    }
                }
            }
        }
        Ok(())
    }

    fn encode_barriers(&self, out: vk::CommandBuffer, barriers: &[Barrier]) {
        let raw: Vec<_> = barriers
            .iter()
            .filter_map(|b| {
                let buffer = self.commands.iter().find_map(|c| c.buffer(b.buffer))?;
                Some(barrier::of(b, buffer.raw()))
            })
            .collect();
        self.device.cmd_barrier(out, &vk::DependencyInfo::default().buffer_memory_barriers(&raw));
    }
}

/// Every buffer that the commands write, with whether its last change is followed by a download.
fn results(commands: &[Command]) -> Vec<(Buffer, bool)> {
    let mut results: Vec<(Buffer, bool)> = Vec::new();
    let mut note = |buffer: &Buffer, fetched| match results.iter_mut().find(|r| r.0.id() == buffer.id()) {
        Some(known) => known.1 = fetched,
        None => results.push((buffer.clone(), fetched)),
    };
    for command in commands {
        if let Op::Copy { from, to, .. } = &command.op
            && from.is_fetched_to(to)
        {
            note(from, true);
            continue;
        }
        for touch in command.touches().iter().filter(|t| t.write) {
            if let Some(buffer) = command.buffer(touch.buffer) {
                note(buffer, false);
            }
        }
    }
    results
}

impl std::fmt::Debug for Program {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (commands, barriers) = self.counts();
        write!(f, "Program({}, {commands} commands, {barriers} barriers)", self.label)
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let device = &self.device.0.device;
        let raw = lock(&self.raw);
        // SAFETY: every run waits, so nothing is pending; null handles are allowed.
        unsafe {
            device.destroy_fence(raw.fence, None);
            device.destroy_command_pool(raw.pool, None);
            device.destroy_descriptor_pool(raw.descriptors, None);
            if let Some((_, queries)) = raw.timed {
                device.destroy_query_pool(queries, None);
            }
        }
    }
}
