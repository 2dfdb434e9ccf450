//! Storage buffers.
use super::device::Device;
use super::error::{lock, vk_error};
use super::memory::Block;
use crate::{Error, Result};
use ash::vk;
use bytemuck::Pod;
use std::ops::Range;
use std::sync::{Arc, Mutex};

/// A storage buffer in device memory. Clones share it; it lives as long as any clone, or any program that uses it.
///
/// Reading and writing from the host is synchronous. Do not write from one thread what a program run by another uses.
#[derive(Clone)]
pub struct Buffer(Arc<Inner>);

struct Inner {
    device: Device,
    name: String,
    raw: vk::Buffer,
    bytes: u64,
    /// `None` only while dropping.
    block: Mutex<Option<Block>>,
}

impl Device {
    /// A zero-filled buffer of `len` elements of `T`.
    pub fn buffer<T: Pod>(&self, name: &str, len: usize) -> Result<Buffer> {
        let buffer = Buffer::create(self, name, byte_len::<T>(len), self.info().mapped)?;
        buffer.clear()?;
        Ok(buffer)
    }

    /// A buffer with these elements.
    pub fn buffer_from<T: Pod>(&self, name: &str, data: &[T]) -> Result<Buffer> {
        let buffer = Buffer::create(self, name, byte_len::<T>(data.len()), self.info().mapped)?;
        buffer.write(data)?;
        Ok(buffer)
    }
}

fn byte_len<T>(len: usize) -> u64 {
    (len as u64).saturating_mul(size_of::<T>() as u64)
}

/// Vulkan knows no empty buffers, and shaders read whole vectors of four words up to the end.
fn padded(bytes: u64) -> u64 {
    bytes.max(16).next_multiple_of(16)
}

impl Buffer {
    fn create(device: &Device, name: &str, bytes: u64, mapped: bool) -> Result<Buffer> {
        let limit = device.info().max_storage_range;
        let mib = |b: u64| b as f64 / f64::from(1 << 20);
        if bytes > limit {
            return Err(Error::gpu(format!(
                "buffer `{name}` needs {:.1} MiB but {} binds at most {:.0} MiB: use fewer splats, smaller photos or another device",
                mib(bytes),
                device.info().name,
                mib(limit)
            )));
        }
        let fail = |e: String| Error::gpu(format!("buffer `{name}` of {:.1} MiB: {e}", mib(bytes)));
        let block = device.0.heap.buffer(&device.0.device, name, padded(bytes), mapped).map_err(fail)?;
        Ok(Buffer(Arc::new(Inner {
            device: device.clone(),
            name: name.to_owned(),
            raw: block.raw,
            bytes,
            block: Mutex::new(Some(block)),
        })))
    }

    /// The name it was made with.
    pub fn name(&self) -> &str {
        &self.0.name
    }

    /// Size in bytes.
    pub fn bytes(&self) -> u64 {
        self.0.bytes
    }

    /// Length in elements of `T`, rounded down.
    pub fn len<T: Pod>(&self) -> usize {
        (self.0.bytes / size_of::<T>().max(1) as u64) as usize
    }

    /// Whether it was made with no elements.
    pub fn is_empty(&self) -> bool {
        self.0.bytes == 0
    }

    pub(super) fn raw(&self) -> vk::Buffer {
        self.0.raw
    }

    /// Bytes that a fill covers and a binding spans.
    pub(super) fn raw_bytes(&self) -> u64 {
        padded(self.0.bytes)
    }

    /// Identity: equal for clones of one buffer.
    pub(super) fn id(&self) -> u64 {
        Arc::as_ptr(&self.0) as u64
    }

    pub(super) fn belongs_to(&self, device: &Device) -> bool {
        Arc::ptr_eq(&self.0.device.0, &device.0)
    }

    /// All elements. The size must be a multiple of `T`'s.
    pub fn read<T: Pod>(&self) -> Result<Vec<T>> {
        if !self.0.bytes.is_multiple_of(size_of::<T>().max(1) as u64) {
            return Err(Error::gpu(format!(
                "buffer `{}` of {} bytes is no whole number of {}-byte elements",
                self.0.name,
                self.0.bytes,
                size_of::<T>()
            )));
        }
        self.read_range(0..self.len::<T>())
    }

    /// Elements of a range.
    pub fn read_range<T: Pod>(&self, range: Range<usize>) -> Result<Vec<T>> {
        let bytes = self.byte_range::<T>(range)?;
        let (start, end) = (bytes.start as usize, bytes.end as usize);
        if start == end {
            return Ok(Vec::new());
        }
        if let Some(memory) = lock(&self.0.block).as_ref().and_then(|b| b.memory.mapped_slice()) {
            return Ok(bytemuck::pod_collect_to_vec(&memory[start..end]));
        }
        let staging = Buffer::create(&self.0.device, "staging", bytes.end - bytes.start, true)?;
        let region = [vk::BufferCopy::default().src_offset(bytes.start).size(bytes.end - bytes.start)];
        self.0.device.one_time("read back", |commands| {
            // SAFETY: ranges were checked, both buffers outlive the submit.
            unsafe { self.0.device.0.device.cmd_copy_buffer(commands, self.raw(), staging.raw(), &region) }
        })?;
        let memory = lock(&staging.0.block);
        let mapped = memory.as_ref().and_then(|b| b.memory.mapped_slice()).ok_or_else(not_mapped)?;
        Ok(bytemuck::pod_collect_to_vec(&mapped[..end - start]))
    }

    /// Replaces the first elements.
    pub fn write<T: Pod>(&self, data: &[T]) -> Result<()> {
        self.write_at(0, data)
    }

    /// Replaces the elements from `first` on.
    pub fn write_at<T: Pod>(&self, first: usize, data: &[T]) -> Result<()> {
        let range = self.byte_range::<T>(first..first.saturating_add(data.len()))?;
        let bytes: &[u8] = bytemuck::cast_slice(data);
        if bytes.is_empty() {
            return Ok(());
        }
        if let Some(memory) = lock(&self.0.block).as_mut().and_then(|b| b.memory.mapped_slice_mut()) {
            memory[range.start as usize..range.end as usize].copy_from_slice(bytes);
            return Ok(());
        }
        let staging = Buffer::create(&self.0.device, "staging", bytes.len() as u64, true)?;
        staging.write(bytes)?;
        let region = [vk::BufferCopy::default().dst_offset(range.start).size(bytes.len() as u64)];
        self.0.device.one_time("upload", |commands| {
            // SAFETY: ranges were checked, both buffers outlive the submit.
            unsafe { self.0.device.0.device.cmd_copy_buffer(commands, staging.raw(), self.raw(), &region) }
        })
    }

    fn clear(&self) -> Result<()> {
        if let Some(memory) = lock(&self.0.block).as_mut().and_then(|b| b.memory.mapped_slice_mut()) {
            memory.fill(0);
            return Ok(());
        }
        self.0.device.one_time("clear", |commands| {
            // SAFETY: the whole buffer is filled, it outlives the submit.
            unsafe { self.0.device.0.device.cmd_fill_buffer(commands, self.raw(), 0, vk::WHOLE_SIZE, 0) }
        })
    }

    fn byte_range<T>(&self, range: Range<usize>) -> Result<Range<u64>> {
        let bytes = byte_len::<T>(range.start)..byte_len::<T>(range.end);
        if bytes.start > bytes.end || bytes.end > self.0.bytes {
            return Err(Error::gpu(format!(
                "elements {range:?} of {} bytes lie outside buffer `{}` of {} bytes",
                size_of::<T>(),
                self.0.name,
                self.0.bytes
            )));
        }
        Ok(bytes)
    }
}

fn not_mapped() -> Error {
    Error::gpu("staging memory is not mapped")
}

impl Device {
    /// Records, submits and waits: for uploads and read-backs on devices without mapped buffers.
    fn one_time(&self, what: &str, record: impl FnOnce(vk::CommandBuffer)) -> Result<()> {
        let device = &self.0.device;
        let pool_info = vk::CommandPoolCreateInfo::default().queue_family_index(self.0.queue_family);
        // SAFETY: objects are created, used and destroyed on one live device; the submit waits before they go.
        unsafe {
            let pool = device.create_command_pool(&pool_info, None).map_err(vk_error(what))?;
            let work = || -> Result<()> {
                let allocate =
                    vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
                let buffers = device.allocate_command_buffers(&allocate).map_err(vk_error(what))?;
                let commands = buffers.first().copied().unwrap_or_default();
                device
                    .begin_command_buffer(commands, &vk::CommandBufferBeginInfo::default())
                    .map_err(vk_error(what))?;
                self.cmd_edge_barrier(commands);
                record(commands);
                self.cmd_edge_barrier(commands);
                device.end_command_buffer(commands).map_err(vk_error(what))?;
                let fence =
                    device.create_fence(&vk::FenceCreateInfo::default(), None).map_err(vk_error(what))?;
                let done = self.submit(commands, fence, what);
                device.destroy_fence(fence, None);
                done
            };
            let done = work();
            device.destroy_command_pool(pool, None);
            done
        }
    }

    /// Orders a command buffer after everything before it and makes its results visible to the host and to what comes
    /// next: put at both ends of every command buffer, so that derivation inside may start from a clean state.
    pub(super) fn cmd_edge_barrier(&self, commands: vk::CommandBuffer) {
        let work = vk::PipelineStageFlags2::COMPUTE_SHADER
            | vk::PipelineStageFlags2::ALL_TRANSFER
            | vk::PipelineStageFlags2::DRAW_INDIRECT;
        let barrier = [vk::MemoryBarrier2::default()
            .src_stage_mask(work)
            .src_access_mask(vk::AccessFlags2::MEMORY_WRITE)
            .dst_stage_mask(work | vk::PipelineStageFlags2::HOST)
            .dst_access_mask(vk::AccessFlags2::MEMORY_READ | vk::AccessFlags2::MEMORY_WRITE)];
        self.cmd_barrier(commands, &vk::DependencyInfo::default().memory_barriers(&barrier));
    }
}

impl std::fmt::Debug for Buffer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Buffer({}, {} bytes)", self.0.name, self.0.bytes)
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        if let Some(block) = lock(&self.block).take() {
            // SAFETY: every submit waits and programs hold their buffers, so nothing uses it any more.
            unsafe { self.device.0.heap.release(&self.device.0.device, block) };
        }
    }
}
