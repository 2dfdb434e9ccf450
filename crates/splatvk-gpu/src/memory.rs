//! Device memory for buffers, and how much of it is in use.
use crate::error::vk_error;
use crate::sync::lock;
use crate::{Error, Result};
use ash::vk;
use gpu_allocator::vulkan::{
    Allocation, AllocationCreateDesc, AllocationScheme, Allocator, AllocatorCreateDesc,
};
use gpu_allocator::{AllocationError, MemoryLocation};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// Memory of the buffers of a device, staging included.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Memory {
    /// Bytes now.
    pub current: u64,
    /// Most bytes at any time since the device was opened or [`crate::Device::reset_peak_memory`].
    pub peak: u64,
    /// Buffers made so far.
    pub allocations: u64,
}

/// Where the buffers of a device come from.
pub(crate) struct Heap {
    /// `None` once closed: the allocator must go before the device.
    allocator: Mutex<Option<Allocator>>,
    current: AtomicU64,
    peak: AtomicU64,
    allocations: AtomicU64,
    /// The driver refuses this allocation and all later ones for lack of memory: see
    /// [`Heap::exhaust_after`].
    #[cfg(feature = "testing")]
    exhausted_from: AtomicU64,
}

/// A Vulkan buffer and the memory it is bound to.
pub(crate) struct Block {
    pub raw: vk::Buffer,
    memory: Allocation,
    mapped: bool,
}

impl Block {
    /// The bytes for the host to read; `None` unless the block was made mapped. Memory that merely
    /// happens to be visible to the host (all of a CPU device's is) does not count, so that
    /// transfers are the same on every device.
    pub fn bytes(&self) -> Option<&[u8]> {
        self.memory.mapped_slice().filter(|_| self.mapped)
    }

    /// The bytes for the host to write; as [`Block::bytes`].
    pub fn bytes_mut(&mut self) -> Option<&mut [u8]> {
        self.memory.mapped_slice_mut().filter(|_| self.mapped)
    }
}

/// An error of the allocator, as the Vulkan result where it has one.
fn refused(what: &str, e: &AllocationError) -> Error {
    match e {
        AllocationError::OutOfMemory => vk_error(what)(vk::Result::ERROR_OUT_OF_DEVICE_MEMORY),
        e => Error::refused(format!("{what}: {e}")),
    }
}

impl Heap {
    pub fn new(instance: &ash::Instance, device: &ash::Device, physical: vk::PhysicalDevice) -> Result<Heap> {
        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: instance.clone(),
            device: device.clone(),
            physical_device: physical,
            debug_settings: gpu_allocator::AllocatorDebugSettings::default(),
            buffer_device_address: false,
            allocation_sizes: gpu_allocator::AllocationSizes::default(),
        })
        .map_err(|e| refused("memory allocator", &e))?;
        Ok(Heap {
            allocator: Mutex::new(Some(allocator)),
            current: AtomicU64::new(0),
            peak: AtomicU64::new(0),
            allocations: AtomicU64::new(0),
            #[cfg(feature = "testing")]
            exhausted_from: AtomicU64::new(u64::MAX),
        })
    }

    /// Makes the driver say, after so many more buffers, that the device has no memory left.
    #[cfg(feature = "testing")]
    pub fn exhaust_after(&self, buffers: u64) {
        self.exhausted_from.store(self.figures().allocations + buffers, Ordering::Relaxed);
    }

    /// A buffer for every use that passes and transfers have; `mapped` puts it where the host reads
    /// and writes it. `what` names it in errors, with its size.
    pub fn buffer(
        &self,
        device: &ash::Device,
        name: &str,
        size: u64,
        mapped: bool,
        what: &str,
    ) -> Result<Block> {
        let usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST
            | vk::BufferUsageFlags::INDIRECT_BUFFER;
        let info = vk::BufferCreateInfo::default().size(size).usage(usage);
        #[cfg(feature = "testing")]
        if self.figures().allocations >= self.exhausted_from.load(Ordering::Relaxed) {
            return Err(refused(what, &AllocationError::OutOfMemory));
        }
        // SAFETY: plain object creation on a live device.
        let raw = unsafe { device.create_buffer(&info, None) }.map_err(vk_error(what))?;
        match self.bind(device, name, raw, mapped, what) {
            Ok(memory) => {
                let now = self.current.fetch_add(memory.size(), Ordering::Relaxed) + memory.size();
                self.peak.fetch_max(now, Ordering::Relaxed);
                self.allocations.fetch_add(1, Ordering::Relaxed);
                Ok(Block { raw, memory, mapped })
            }
            Err(e) => {
                // SAFETY: the buffer was never used.
                unsafe { device.destroy_buffer(raw, None) };
                Err(e)
            }
        }
    }

    fn bind(
        &self,
        device: &ash::Device,
        name: &str,
        raw: vk::Buffer,
        mapped: bool,
        what: &str,
    ) -> Result<Allocation> {
        // SAFETY: the buffer is alive and unbound.
        let requirements = unsafe { device.get_buffer_memory_requirements(raw) };
        let mut guard = lock(&self.allocator);
        let allocator = guard.as_mut().ok_or_else(|| Error::refused("the device is closing"))?;
        // GpuToCpu is cached host memory: read-backs and CPU devices need it, uploads do not
        // suffer.
        let location = if mapped { MemoryLocation::GpuToCpu } else { MemoryLocation::GpuOnly };
        let allocation = allocator
            .allocate(&AllocationCreateDesc {
                name,
                requirements,
                location,
                linear: true,
                allocation_scheme: AllocationScheme::GpuAllocatorManaged,
            })
            .map_err(|e| refused(what, &e))?;
        // SAFETY: memory and offset come from the allocator for these requirements.
        match unsafe { device.bind_buffer_memory(raw, allocation.memory(), allocation.offset()) } {
            Ok(()) => Ok(allocation),
            Err(e) => {
                let _ = allocator.free(allocation);
                Err(vk_error(what)(e))
            }
        }
    }

    /// Destroys a buffer.
    ///
    /// # Safety
    /// No command buffer that uses it is pending.
    pub unsafe fn release(&self, device: &ash::Device, block: Block) {
        // SAFETY: per the contract.
        unsafe { device.destroy_buffer(block.raw, None) };
        self.current.fetch_sub(block.memory.size(), Ordering::Relaxed);
        if let Some(allocator) = lock(&self.allocator).as_mut() {
            let _ = allocator.free(block.memory);
        }
    }

    /// Gives all memory back to the driver; no buffer can be made any more.
    pub fn close(&self) {
        drop(lock(&self.allocator).take());
    }

    pub fn figures(&self) -> Memory {
        Memory {
            current: self.current.load(Ordering::Relaxed),
            peak: self.peak.load(Ordering::Relaxed),
            allocations: self.allocations.load(Ordering::Relaxed),
        }
    }

    pub fn reset_peak(&self) {
        self.peak.store(self.current.load(Ordering::Relaxed), Ordering::Relaxed);
    }
}
