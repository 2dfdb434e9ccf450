//! Mapped memory through which the host reaches buffers that are not, and what waits in it for the
//! next submission.
use crate::error::vk_error;
use crate::memory::{Block, Heap};
use crate::{Error, Result};
use ash::vk;

/// Most bytes that wait at once; larger transfers go in pieces. 16 MiB take over a millisecond on
/// PCIe 4 ×16, against some 20 µs for a submission.
pub(crate) const MOST: u64 = 16 << 20;
/// Bytes of a new batch; a training step sends a few hundred.
const LEAST: u64 = 64 << 10;

/// Transfers that the next submission performs before its own commands.
pub(crate) enum Pending {
    /// Bytes of the batch go to a buffer.
    Write { target: vk::Buffer, at: u64, from: u64, bytes: u64 },
    /// A buffer becomes zero.
    Clear { target: vk::Buffer },
}

impl Pending {
    pub fn target(&self) -> vk::Buffer {
        match *self {
            Pending::Write { target, .. } | Pending::Clear { target } => target,
        }
    }
}

/// Mapped memory with the command buffer that copies from or to it. Used again once its submission
/// is done.
#[derive(Default)]
pub(crate) struct Batch {
    block: Option<Block>,
    capacity: u64,
    used: u64,
    pub pending: Vec<Pending>,
    pool: vk::CommandPool,
    pub commands: vk::CommandBuffer,
    pub fence: vk::Fence,
}

impl Batch {
    /// Makes room for `bytes` more; what waits already stays.
    pub fn reserve(&mut self, device: &ash::Device, heap: &Heap, bytes: u64) -> Result<()> {
        let needed = self.used + bytes;
        if needed <= self.capacity {
            return Ok(());
        }
        let capacity = needed.next_power_of_two().max(LEAST);
        let what = format!("staging memory of {} KiB", capacity >> 10);
        let mut block = heap.buffer(device, "staging", capacity, true, &what)?;
        if let Some(old) = self.block.take() {
            if let (Some(from), Some(to)) = (old.bytes(), block.bytes_mut()) {
                let used = self.used as usize;
                to[..used].copy_from_slice(&from[..used]);
            }
            // SAFETY: a batch is filled between submissions, so nothing uses its memory.
            unsafe { heap.release(device, old) };
        }
        (self.block, self.capacity) = (Some(block), capacity);
        Ok(())
    }

    /// Keeps bytes for `at` bytes into `target`; room is reserved.
    pub fn push(&mut self, target: vk::Buffer, at: u64, data: &[u8]) -> Result<()> {
        let (from, bytes) = (self.used, data.len() as u64);
        let memory = self.block.as_mut().and_then(Block::bytes_mut).ok_or_else(not_mapped)?;
        memory[from as usize..][..data.len()].copy_from_slice(data);
        // Drivers are fast at copies of whole words.
        self.used = (from + bytes).next_multiple_of(16).min(self.capacity);
        self.pending.push(Pending::Write { target, at, from, bytes });
        Ok(())
    }

    /// Bytes that wait.
    pub fn used(&self) -> u64 {
        self.used
    }

    /// The memory, once reserved.
    pub fn raw(&self) -> vk::Buffer {
        self.block.as_ref().map(|b| b.raw).unwrap_or_default()
    }

    /// The bytes that the device wrote.
    pub fn bytes(&self) -> Result<&[u8]> {
        self.block.as_ref().and_then(Block::bytes).ok_or_else(not_mapped)
    }

    /// Begins the command buffer anew.
    pub fn begin(&mut self, device: &ash::Device, queue_family: u32) -> Result<()> {
        let error = || vk_error("transfers");
        // SAFETY: objects of one live device; nothing of this batch is pending.
        unsafe {
            if self.pool == vk::CommandPool::null() {
                let info = vk::CommandPoolCreateInfo::default().queue_family_index(queue_family);
                self.pool = device.create_command_pool(&info, None).map_err(error())?;
                let info =
                    vk::CommandBufferAllocateInfo::default().command_pool(self.pool).command_buffer_count(1);
                let made = device.allocate_command_buffers(&info).map_err(error())?;
                self.commands = made.first().copied().unwrap_or_default();
                self.fence = device.create_fence(&vk::FenceCreateInfo::default(), None).map_err(error())?;
            }
            device.reset_command_pool(self.pool, vk::CommandPoolResetFlags::empty()).map_err(error())?;
            let info =
                vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
            device.begin_command_buffer(self.commands, &info).map_err(error())
        }
    }

    fn clear(&mut self) {
        self.used = 0;
        self.pending.clear();
    }

    fn destroy(&mut self, device: &ash::Device, heap: &Heap) {
        // SAFETY: nothing is pending when a device closes; null handles are allowed.
        unsafe {
            device.destroy_fence(self.fence, None);
            device.destroy_command_pool(self.pool, None);
            if let Some(block) = self.block.take() {
                heap.release(device, block);
            }
        }
    }
}

fn not_mapped() -> Error {
    Error::refused("staging memory is not mapped")
}

/// A submitted batch's buffers: they must outlive it.
struct Flight {
    number: u64,
    targets: Vec<vk::Buffer>,
    /// Buffers that were dropped meanwhile.
    dead: Vec<Block>,
}

/// The frames of a device.
#[derive(Default)]
pub(crate) struct Staging {
    /// Collects the transfers of the next submission.
    pub current: Batch,
    spare: Vec<Batch>,
    flights: Vec<Flight>,
    launched: u64,
}

impl Staging {
    /// A batch to use for something else; give it back with [`Staging::give`].
    pub fn take(&mut self) -> Batch {
        let largest = (0..self.spare.len()).max_by_key(|&i| self.spare[i].capacity);
        largest.map(|i| self.spare.swap_remove(i)).unwrap_or_default()
    }

    pub fn give(&mut self, mut batch: Batch) {
        batch.clear();
        self.spare.push(batch);
    }

    /// Takes the current batch, if anything waits in it, and remembers its targets under a number
    /// until [`Staging::land`].
    pub fn launch(&mut self) -> Option<(u64, Batch)> {
        if self.current.pending.is_empty() {
            return None;
        }
        let next = self.take();
        let batch = std::mem::replace(&mut self.current, next);
        self.launched += 1;
        let targets = batch.pending.iter().map(Pending::target).collect();
        self.flights.push(Flight { number: self.launched, targets, dead: Vec::new() });
        Some((self.launched, batch))
    }

    /// Takes a launched batch back when the device is done with it.
    pub fn land(&mut self, device: &ash::Device, heap: &Heap, number: u64, batch: Batch) {
        self.give(batch);
        if let Some(at) = self.flights.iter().position(|f| f.number == number) {
            for block in self.flights.swap_remove(at).dead {
                // SAFETY: the submission is done, and so are those before it.
                unsafe { heap.release(device, block) };
            }
        }
    }

    /// Destroys a buffer that nobody holds any more, or has it done when the last batch that writes
    /// to it lands.
    pub fn defer_free(&mut self, device: &ash::Device, heap: &Heap, block: Block) {
        self.current.pending.retain(|p| p.target() != block.raw);
        let last =
            self.flights.iter_mut().filter(|f| f.targets.contains(&block.raw)).max_by_key(|f| f.number);
        match last {
            Some(flight) => flight.dead.push(block),
            // SAFETY: programs hold their buffers, and no transfer of it is under way.
            None => unsafe { heap.release(device, block) },
        }
    }

    pub fn close(&mut self, device: &ash::Device, heap: &Heap) {
        self.current.destroy(device, heap);
        self.spare.iter_mut().for_each(|batch| batch.destroy(device, heap));
    }
}
