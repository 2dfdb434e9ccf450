//! Storage buffers.
use crate::device::Device;
use crate::memory::Block;
use crate::sync::lock;
use crate::{Error, Result};
use ash::vk;
use bytemuck::Pod;
use std::marker::PhantomData;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};

/// A storage buffer of `T` in device memory. Clones share it; it lives as long as any clone, or any
/// program that uses it.
///
/// The bindings of a shader ask for the element that its source declares: the scalar of scalars,
/// vectors and arrays of them, so that a `vec4[]` and a `float[]` are both `Buffer<f32>` and their
/// lengths count floats; the generated structure of structures. [`Buffer::cast`] is for memory that
/// is declared in two ways. A plain `Buffer` is one of words, `u32`.
///
/// On memory that is not mapped, what the host writes waits for the next submission and goes along
/// with it, and what a recording has downloaded ([`crate::Recorder::download`]) is read without
/// one; other reads submit and wait. Do not write from one thread what a program run by another
/// uses.
pub struct Buffer<T = u32>(Arc<Inner>, PhantomData<fn() -> T>);

struct Inner {
    device: Device,
    name: String,
    raw: vk::Buffer,
    bytes: u64,
    /// `None` only while dropping.
    block: Mutex<Option<Block>>,
    /// Target of recorded downloads, and whether its content is that of the buffer.
    host: OnceLock<Buffer>,
    fetched: AtomicBool,
}

impl Device {
    /// A zero-filled buffer of `len` elements of `T`.
    pub fn buffer<T: Pod>(&self, name: &str, len: usize) -> Result<Buffer<T>> {
        let buffer = Buffer::create(self, name, byte_len::<T>(len), self.info().mapped)?;
        buffer.clear()?;
        Ok(buffer)
    }

    /// A buffer with these elements.
    pub fn buffer_from<T: Pod>(&self, name: &str, data: &[T]) -> Result<Buffer<T>> {
        let buffer = Buffer::create(self, name, byte_len::<T>(data.len()), self.info().mapped)?;
        buffer.write(data)?;
        Ok(buffer)
    }
}

fn byte_len<T>(len: usize) -> u64 {
    (len as u64).saturating_mul(size_of::<T>() as u64)
}

/// The error of a buffer that exceeds a limit of the device.
pub(crate) fn too_large(device: &Device, name: &str, bytes: u64, limit: u64) -> Error {
    let mib = |b: u64| b as f64 / f64::from(1 << 20);
    Error::TooLarge(format!(
        "buffer `{name}` needs {:.1} MiB but {} binds at most {:.0} MiB: use fewer splats, smaller photos or another device",
        mib(bytes),
        device.info().name,
        mib(limit)
    ))
}

/// Vulkan has no empty buffers, and shaders read whole vectors of four words up to the end.
fn padded(bytes: u64) -> u64 {
    bytes.max(16).next_multiple_of(16)
}

impl<T> Clone for Buffer<T> {
    fn clone(&self) -> Self {
        self.cast()
    }
}

impl<T> Buffer<T> {
    fn create(device: &Device, name: &str, bytes: u64, mapped: bool) -> Result<Self> {
        let limit = device.info().max_buffer;
        let mib = |b: u64| b as f64 / f64::from(1 << 20);
        if bytes > limit {
            return Err(too_large(device, name, bytes, limit));
        }
        let what = format!("buffer `{name}` of {:.1} MiB", mib(bytes));
        let block = device.0.heap.buffer(&device.0.device, name, padded(bytes), mapped, &what)?;
        let inner = Inner {
            device: device.clone(),
            name: name.to_owned(),
            raw: block.raw,
            bytes,
            block: Mutex::new(Some(block)),
            host: OnceLock::new(),
            fetched: AtomicBool::new(false),
        };
        Ok(Buffer(Arc::new(inner), PhantomData))
    }

    /// The same memory with elements of another type; both handles share it. What does not fill a
    /// last element is not counted by [`Buffer::len`].
    pub fn cast<U>(&self) -> Buffer<U> {
        Buffer(self.0.clone(), PhantomData)
    }

    /// The name it was made with.
    pub fn name(&self) -> &str {
        &self.0.name
    }

    /// Size in bytes.
    pub fn bytes(&self) -> u64 {
        self.0.bytes
    }

    /// Length in elements, rounded down.
    pub fn len(&self) -> usize {
        (self.0.bytes / size_of::<T>().max(1) as u64) as usize
    }

    /// Whether it was made with no elements.
    pub fn is_empty(&self) -> bool {
        self.0.bytes == 0
    }

    pub(crate) fn raw(&self) -> vk::Buffer {
        self.0.raw
    }

    /// Bytes that a fill covers and a binding spans.
    pub(crate) fn raw_bytes(&self) -> u64 {
        padded(self.0.bytes)
    }

    /// Identity: equal for clones of one buffer.
    #[doc(hidden)]
    pub fn id(&self) -> u64 {
        Arc::as_ptr(&self.0) as u64
    }

    pub(crate) fn belongs_to(&self, device: &Device) -> bool {
        Arc::ptr_eq(&self.0.device.0, &device.0)
    }

    fn clear(&self) -> Result<()> {
        if let Some(memory) = lock(&self.0.block).as_mut().and_then(Block::bytes_mut) {
            memory.fill(0);
            return Ok(());
        }
        self.0.device.staged_clear(self.raw())
    }

    /// The mapped buffer that recorded downloads copy to.
    pub(crate) fn host_copy(&self) -> Result<&Buffer> {
        if let Some(copy) = self.0.host.get() {
            return Ok(copy);
        }
        let name = format!("{} on the host", self.0.name);
        let made = Buffer::create(&self.0.device, &name, self.0.bytes, true)?;
        Ok(self.0.host.get_or_init(|| made))
    }

    /// Whether `other` comes from [`Buffer::host_copy`].
    pub(crate) fn is_fetched_to<U>(&self, other: &Buffer<U>) -> bool {
        self.0.host.get().is_some_and(|copy| copy.id() == other.id())
    }

    /// Marks the host's copy as equal to the buffer, or as outdated.
    pub(crate) fn set_fetched(&self, fetched: bool) {
        self.0.fetched.store(fetched, Ordering::Release);
    }

    fn byte_range(&self, range: Range<usize>) -> Result<Range<u64>> {
        let bytes = byte_len::<T>(range.start)..byte_len::<T>(range.end);
        if bytes.start > bytes.end || bytes.end > self.0.bytes {
            return Err(Error::refused(format!(
                "elements {range:?} of {} bytes lie outside buffer `{}` of {} bytes",
                size_of::<T>(),
                self.0.name,
                self.0.bytes
            )));
        }
        Ok(bytes)
    }
}

impl<T: Pod> Buffer<T> {
    /// All elements. After a [`Buffer::cast`] the size must still be a whole number of them.
    pub fn read(&self) -> Result<Vec<T>> {
        if !self.0.bytes.is_multiple_of(size_of::<T>().max(1) as u64) {
            return Err(Error::refused(format!(
                "buffer `{}` of {} bytes is no whole number of {}-byte elements",
                self.0.name,
                self.0.bytes,
                size_of::<T>()
            )));
        }
        self.read_range(0..self.len())
    }

    /// Elements of a range.
    pub fn read_range(&self, range: Range<usize>) -> Result<Vec<T>> {
        let mut out = Vec::with_capacity(range.len());
        self.read_with(range, &mut |_, piece| out.extend_from_slice(piece))?;
        Ok(out)
    }

    /// Passes the elements of a range to `visit` piece by piece, each with its place in the range,
    /// without a copy. `visit` must not use the buffer.
    pub fn read_with(&self, range: Range<usize>, visit: &mut dyn FnMut(usize, &[T])) -> Result<()> {
        let bytes = self.byte_range(range)?;
        let (start, end) = (bytes.start as usize, bytes.end as usize);
        if start == end {
            return Ok(());
        }
        self.0.device.0.transfers.read((end - start) as u64);
        let fetched = self.0.host.get().filter(|_| self.0.fetched.load(Ordering::Acquire));
        for mapped in [Some(self.cast()), fetched.cloned()].into_iter().flatten() {
            if let Some(memory) = lock(&mapped.0.block).as_ref().and_then(Block::bytes) {
                visit(0, bytemuck::cast_slice(&memory[start..end]));
                return Ok(());
            }
        }
        let mut at = 0;
        self.0.device.staged_read(self.raw(), bytes, &mut |piece| {
            let piece: &[T] = bytemuck::cast_slice(piece);
            visit(at, piece);
            at += piece.len();
        })
    }

    /// Replaces the first elements.
    pub fn write(&self, data: &[T]) -> Result<()> {
        self.write_at(0, data)
    }

    /// Replaces the elements from `first` on.
    pub fn write_at(&self, first: usize, data: &[T]) -> Result<()> {
        let range = self.byte_range(first..first.saturating_add(data.len()))?;
        let bytes: &[u8] = bytemuck::cast_slice(data);
        if bytes.is_empty() {
            return Ok(());
        }
        self.0.device.0.transfers.written(bytes.len() as u64);
        if let Some(memory) = lock(&self.0.block).as_mut().and_then(Block::bytes_mut) {
            memory[range.start as usize..range.end as usize].copy_from_slice(bytes);
            return Ok(());
        }
        self.set_fetched(false);
        self.0.device.staged_write(self.raw(), range.start, bytes)
    }
}

/// The mapped memory of a buffer, which nothing else uses meanwhile.
pub(crate) struct Mapped<'a>(MutexGuard<'a, Option<Block>>);

impl Mapped<'_> {
    /// All bytes, also the padding.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        self.0.as_mut().and_then(Block::bytes_mut).unwrap_or_default()
    }
}

impl Buffer {
    /// The memory, if it is mapped.
    pub(crate) fn mapped(&self) -> Option<Mapped<'_>> {
        let block = lock(&self.0.block);
        block.as_ref().is_some_and(|b| b.bytes().is_some()).then_some(Mapped(block))
    }
}

impl<T> std::fmt::Debug for Buffer<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Buffer({}, {} bytes)", self.0.name, self.0.bytes)
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        if let Some(block) = lock(&self.block).take() {
            lock(&self.device.0.staging).defer_free(&self.device.0.device, &self.device.0.heap, block);
        }
    }
}
