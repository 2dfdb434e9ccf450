//! A compiled recording: command buffers that can be submitted again and again.
use crate::barrier;
use crate::buffer::{Buffer, too_large};
use crate::call::Call;
use crate::command::{self, Command, Groups, Op};
use crate::device::Device;
use crate::error::vk_error;
use crate::executor::Executor;
use crate::hazard::{self, Barrier, Step};
use crate::module::Module;
use crate::native;
use crate::sync::lock;
use crate::{Error, Result};
use ash::vk;
use std::collections::HashMap;
use std::ops::Range;
use std::sync::Mutex;
use std::time::Instant;

mod running;
pub use running::Running;

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
    plain: Vec<Segment>,
    /// With timestamps; encoded when first asked for.
    timed: Option<(Vec<Segment>, vk::QueryPool)>,
}

/// Commands that run one after the other in one place.
#[derive(Clone)]
enum Segment {
    /// On the device, one submission.
    Device(vk::CommandBuffer),
    /// In native code.
    Native(Range<usize>),
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
            plain: Vec::new(),
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
        self.submit(&raw.plain, raw.fence, &mut |_, _| ())
    }

    /// The executor that replaces the device, in tests.
    fn executor(&self) -> Option<&dyn Executor> {
        self.device.0.stand_in.as_deref()
    }

    /// Runs all segments; `native` receives each command of native code with its milliseconds.
    fn submit(
        &self,
        segments: &[Segment],
        fence: vk::Fence,
        native: &mut dyn FnMut(usize, f64),
    ) -> Result<()> {
        if let Some(executor) = self.executor() {
            let commands: Vec<&Op> = self.commands.iter().map(|c| &c.op).collect();
            return executor.run(&commands).map_err(|e| Error::refused(format!("{}: {e}", self.label)));
        }
        self.forget_results();
        for segment in segments {
            match segment {
                Segment::Device(commands) => self.device.submit(*commands, fence, &self.label)?,
                Segment::Native(range) => {
                    for index in range.clone() {
                        let clock = Instant::now();
                        native::run(self.device.0.natives, &self.commands[index].op, &self.label)?;
                        native(index, 1e3 * clock.elapsed().as_secs_f64());
                    }
                }
            }
        }
        self.note_results();
        Ok(())
    }

    /// Marks what the host has of the results as outdated.
    fn forget_results(&self) {
        self.results.iter().for_each(|(buffer, _)| buffer.set_fetched(false));
    }

    /// Marks the downloaded results as those of the last run, which has ended.
    fn note_results(&self) {
        self.results.iter().for_each(|(buffer, fetched)| buffer.set_fetched(*fetched));
    }

    /// Divides the commands by where they run: whether in native code, and which. Fills and copies
    /// run where the command before them does, since a change of place is a submission more.
    fn places(&self) -> Vec<(bool, Range<usize>)> {
        let natives = self.device.0.natives;
        let is_native = |command: &Command| match &command.op {
            Op::Dispatch { call, .. } => Some(native::find(natives, call.family.name).is_some()),
            Op::Fill { .. } | Op::Copy { .. } => None,
        };
        let mut current = self.commands.iter().find_map(is_native).unwrap_or(false);
        let mut places: Vec<(bool, Range<usize>)> = Vec::new();
        for (index, command) in self.commands.iter().enumerate() {
            current = is_native(command).unwrap_or(current);
            match places.last_mut().filter(|p| p.0 == current) {
                Some((_, range)) => range.end = index + 1,
                None => places.push((current, index..index + 1)),
            }
        }
        places
    }

    /// Records the segments, with timestamps into `queries`.
    fn segments(&self, raw: &Raw, queries: Option<vk::QueryPool>) -> Result<Vec<Segment>> {
        let count = (2 * self.commands.len()).max(1) as u32;
        let mut first = true;
        let record = |(is_native, range): (bool, Range<usize>)| {
            if is_native {
                return Ok(Segment::Native(range));
            }
            let commands = self.begin(raw)?;
            if let Some(pool) = queries.filter(|_| std::mem::take(&mut first)) {
                // SAFETY: recording; the pool has `count` queries.
                unsafe { self.device.0.device.cmd_reset_query_pool(commands, pool, 0, count) };
            }
            self.encode(raw, commands, &range, queries)?;
            Ok(Segment::Device(commands))
        };
        self.places().into_iter().map(record).collect()
    }

    /// Submits and waits; milliseconds per command, in order.
    pub fn run_timed(&self) -> Result<Vec<(String, f64)>> {
        let period = self.device.info().timestamp_period;
        if period == 0.0 {
            return Err(Error::refused(format!("{} has no timestamps", self.device.info().name)));
        }
        let mut raw = lock(&self.raw);
        let (segments, pool) = match &raw.timed {
            Some(timed) => timed.clone(),
            None => {
                let timed = self.encode_timed(&raw)?;
                raw.timed = Some(timed.clone());
                timed
            }
        };
        let mut times = vec![0.0; self.commands.len()];
        self.submit(&segments, raw.fence, &mut |index, ms| times[index] = ms)?;
        let flags = vk::QueryResultFlags::TYPE_64 | vk::QueryResultFlags::WAIT;
        for (is_native, range) in self.places() {
            if is_native {
                continue;
            }
            let mut ticks = vec![0u64; 2 * range.len()];
            // SAFETY: the pool has two queries per command; those of the range are written by the
            // finished submit.
            unsafe {
                let first = 2 * range.start as u32;
                self.device.0.device.get_query_pool_results(pool, first, &mut ticks, flags)
            }
            .map_err(vk_error(&self.label))?;
            let ms = |pair: &[u64]| pair[1].saturating_sub(pair[0]) as f64 * period / 1e6;
            times[range].iter_mut().zip(ticks.chunks_exact(2)).for_each(|(time, pair)| *time = ms(pair));
        }
        Ok(self.commands.iter().zip(times).map(|(c, ms)| (c.label.clone(), ms)).collect())
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
        raw.plain = self.segments(&raw, None)?;
        Ok(())
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
            // Native code needs no descriptors, and no pipeline.
            if native::find(self.device.0.natives, call.family.name).is_some() {
                by_command.push(None);
                continue;
            }
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
            let limit = self.device.info().max_storage_range;
            if buffer.bytes() > limit {
                return Err(too_large(&self.device, buffer.name(), buffer.bytes(), limit));
            }
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

    fn encode_timed(&self, raw: &Raw) -> Result<(Vec<Segment>, vk::QueryPool)> {
        let device = &self.device.0.device;
        let count = (2 * self.commands.len()).max(1) as u32;
        let info = vk::QueryPoolCreateInfo::default().query_type(vk::QueryType::TIMESTAMP).query_count(count);
        // SAFETY: plain object creation on a live device.
        let queries = unsafe { device.create_query_pool(&info, None) }.map_err(vk_error(&self.label))?;
        self.segments(raw, Some(queries)).map(|segments| (segments, queries)).inspect_err(|_| {
            // SAFETY: never submitted.
            unsafe { device.destroy_query_pool(queries, None) }
        })
    }

    /// Records the steps of a range of commands into a command buffer that has begun, and ends it.
    fn encode(
        &self,
        raw: &Raw,
        out: vk::CommandBuffer,
        range: &Range<usize>,
        queries: Option<vk::QueryPool>,
    ) -> Result<()> {
        let device = &self.device.0.device;
        let stamp = |index: usize| {
            if let Some(pool) = queries {
                let stage = vk::PipelineStageFlags::BOTTOM_OF_PIPE;
                // SAFETY: recording; `index` lies in the pool.
                unsafe { device.cmd_write_timestamp(out, stage, pool, index as u32) };
            }
        };
        self.device.cmd_edge_barrier(out);
        let mut next = 0;
        for step in &self.steps {
            let is_inside = range.contains(&next);
            match step {
                Step::Barriers(barriers) if is_inside => self.encode_barriers(out, barriers),
                Step::Command(index) => {
                    next = index + 1;
                    if !is_inside {
                        continue;
                    }
                    stamp(2 * index);
                    self.encode_command(out, &self.commands[*index], raw.sets[*index])?;
                    stamp(2 * index + 1);
                }
                Step::Barriers(_) => {}
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
        // SAFETY: every run waits, also that of a dropped `Running`, so nothing is pending; null
        // handles are allowed.
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
