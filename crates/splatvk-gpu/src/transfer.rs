//! Submissions, and the transfers that go along with them on memory that is not mapped.
use crate::Result;
use crate::barrier;
use crate::device::Device;
use crate::error::vk_error;
use crate::hazard::{self, AccessStage, BufferAccess, Step};
use crate::staging::{Batch, MOST, Pending, Staging};
use crate::sync::lock;
use ash::vk::{self, Handle};
use std::ops::Range;

/// Commands that the device may still work on, with the transfers before them.
#[must_use]
pub(crate) struct Submitted {
    fence: vk::Fence,
    transfers: Option<(u64, Batch)>,
}

impl Device {
    /// Submits what waits for a transfer and then these commands, all at once, and waits until the
    /// device is done.
    pub(crate) fn submit(&self, commands: vk::CommandBuffer, fence: vk::Fence, what: &str) -> Result<()> {
        let submitted = self.send(commands, fence, what)?;
        self.wait(submitted, what)
    }

    /// [`Device::submit`] without the wait. The fence belongs to the submission until
    /// [`Device::wait`].
    pub(crate) fn send(
        &self,
        commands: vk::CommandBuffer,
        fence: vk::Fence,
        what: &str,
    ) -> Result<Submitted> {
        let mut staging = lock(&self.0.staging);
        let transfers = self.launch(&mut staging)?;
        let first = transfers.iter().map(|(_, batch)| batch.commands);
        let all: Vec<_> = first.chain([commands]).collect();
        let sent = self.queue_submit(&[vk::SubmitInfo::default().command_buffers(&all)], fence);
        drop(staging);
        let submitted = Submitted { fence, transfers };
        match sent {
            Ok(()) => Ok(submitted),
            Err(e) => {
                self.land(submitted);
                Err(vk_error(what)(e))
            }
        }
    }

    /// Waits until the device is done.
    pub(crate) fn wait(&self, submitted: Submitted, what: &str) -> Result<()> {
        let done = self.finish(submitted.fence, what);
        self.land(submitted);
        done
    }

    fn land(&self, submitted: Submitted) {
        if let Some((number, batch)) = submitted.transfers {
            lock(&self.0.staging).land(&self.0.device, &self.0.heap, number, batch);
        }
    }

    /// Submits what waits for a transfer, if anything does.
    pub(crate) fn flush(&self) -> Result<()> {
        let mut staging = lock(&self.0.staging);
        self.flush_locked(&mut staging)
    }

    fn flush_locked(&self, staging: &mut Staging) -> Result<()> {
        let Some((number, batch)) = self.launch(staging)? else { return Ok(()) };
        let commands = [batch.commands];
        let submit = vk::SubmitInfo::default().command_buffers(&commands);
        let sent = self.queue_submit(&[submit], batch.fence).map_err(vk_error("upload"));
        let done = sent.and_then(|()| self.finish(batch.fence, "upload"));
        staging.land(&self.0.device, &self.0.heap, number, batch);
        done
    }

    fn finish(&self, fence: vk::Fence, what: &str) -> Result<()> {
        let device = &self.0.device;
        // SAFETY: the fence was submitted.
        unsafe { device.wait_for_fences(&[fence], true, u64::MAX) }.map_err(vk_error(what))?;
        // SAFETY: the fence is signalled and not in use.
        unsafe { device.reset_fences(&[fence]) }.map_err(vk_error(what))
    }

    /// Bytes for a buffer; they are there before whatever is submitted next begins.
    pub(crate) fn staged_write(&self, target: vk::Buffer, at: u64, data: &[u8]) -> Result<()> {
        let mut staging = lock(&self.0.staging);
        for (index, piece) in data.chunks(MOST as usize).enumerate() {
            if staging.current.used() + piece.len() as u64 > MOST {
                self.flush_locked(&mut staging)?;
            }
            staging.current.reserve(&self.0.device, &self.0.heap, piece.len() as u64)?;
            staging.current.push(target, at + index as u64 * MOST, piece)?;
        }
        Ok(())
    }

    /// Zeros for a whole buffer, as [`Device::staged_write`].
    pub(crate) fn staged_clear(&self, target: vk::Buffer) -> Result<()> {
        lock(&self.0.staging).current.pending.push(Pending::Clear { target });
        Ok(())
    }

    /// Copies bytes of a buffer to the host, piece by piece.
    pub(crate) fn staged_read(
        &self,
        source: vk::Buffer,
        range: Range<u64>,
        seen: &mut dyn FnMut(&[u8]),
    ) -> Result<()> {
        let mut batch = lock(&self.0.staging).take();
        let done = self.read_through(&mut batch, source, range, seen);
        lock(&self.0.staging).give(batch);
        done
    }

    fn read_through(
        &self,
        batch: &mut Batch,
        source: vk::Buffer,
        range: Range<u64>,
        seen: &mut dyn FnMut(&[u8]),
    ) -> Result<()> {
        let device = &self.0.device;
        for start in range.clone().step_by(MOST as usize) {
            let bytes = (range.end - start).min(MOST);
            batch.reserve(device, &self.0.heap, bytes)?;
            batch.begin(device, self.0.queue_family)?;
            self.cmd_edge_barrier(batch.commands);
            let region = [vk::BufferCopy::default().src_offset(start).size(bytes)];
            // SAFETY: recording; the caller holds the source and has checked the range.
            unsafe { device.cmd_copy_buffer(batch.commands, source, batch.raw(), &region) };
            self.cmd_edge_barrier(batch.commands);
            // SAFETY: recording.
            unsafe { device.end_command_buffer(batch.commands) }.map_err(vk_error("read back"))?;
            self.submit(batch.commands, batch.fence, "read back")?;
            seen(&batch.bytes()?[..bytes as usize]);
        }
        Ok(())
    }

    /// Takes the batch in which transfers wait, if any do, its commands encoded.
    fn launch(&self, staging: &mut Staging) -> Result<Option<(u64, Batch)>> {
        let Some((number, mut batch)) = staging.launch() else { return Ok(None) };
        match self.encode_transfers(&mut batch) {
            Ok(()) => Ok(Some((number, batch))),
            Err(e) => {
                staging.land(&self.0.device, &self.0.heap, number, batch);
                Err(e)
            }
        }
    }

    fn encode_transfers(&self, batch: &mut Batch) -> Result<()> {
        let device = &self.0.device;
        batch.begin(device, self.0.queue_family)?;
        let (out, staged) = (batch.commands, batch.raw());
        let touch = |p: &Pending| BufferAccess {
            buffer: p.target().as_raw(),
            stage: AccessStage::Transfer,
            read: false,
            write: true,
        };
        let touches: Vec<_> = batch.pending.iter().map(|p| vec![touch(p)]).collect();
        self.cmd_edge_barrier(out);
        for step in hazard::derive(&touches) {
            match step {
                Step::Barriers(barriers) => {
                    let raw: Vec<_> =
                        barriers.iter().map(|b| barrier::of(b, vk::Buffer::from_raw(b.buffer))).collect();
                    self.cmd_barrier(out, &vk::DependencyInfo::default().buffer_memory_barriers(&raw));
                }
                // SAFETY: recording; ranges were checked when the bytes were taken, and a dropped
                // buffer leaves the list.
                Step::Command(index) => unsafe {
                    match batch.pending[index] {
                        Pending::Write { target, at, from, bytes } => {
                            let region = [vk::BufferCopy { src_offset: from, dst_offset: at, size: bytes }];
                            device.cmd_copy_buffer(out, staged, target, &region);
                        }
                        Pending::Clear { target } => {
                            device.cmd_fill_buffer(out, target, 0, vk::WHOLE_SIZE, 0);
                        }
                    }
                },
            }
        }
        self.cmd_edge_barrier(out);
        // SAFETY: recording.
        unsafe { device.end_command_buffer(out) }.map_err(vk_error("transfers"))
    }

    /// Orders a command buffer after everything before it and makes its results visible to the host
    /// and to what comes next: put at both ends of every command buffer, so that derivation inside
    /// may start from a clean state.
    pub(crate) fn cmd_edge_barrier(&self, commands: vk::CommandBuffer) {
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
