//! Handing results to buffers and images of the host program, on a device that it shares with
//! splatvk.
use crate::buffer::Buffer;
use crate::device::Device;
use crate::error::vk_error;
use crate::{Error, Result};
use ash::vk;

/// Where a result goes.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub enum Target {
    /// A buffer of the host with `TRANSFER_DST` usage.
    Buffer {
        /// The host's buffer.
        raw: vk::Buffer,
        /// First byte.
        offset: u64,
    },
    /// An image of the host with `TRANSFER_DST` usage: 2D, mip level 0, layers from 0 on, colour
    /// aspect.
    Image {
        /// The host's image.
        raw: vk::Image,
        /// Width and height, pixels.
        size: [u32; 2],
        /// Array layers written.
        layers: u32,
        /// Layout that it has; `UNDEFINED` if its content may be lost.
        before: vk::ImageLayout,
        /// Layout that it gets.
        after: vk::ImageLayout,
    },
}

/// Points of timeline semaphores, each (semaphore, value).
#[derive(Clone, Copy, Debug, Default)]
pub struct Sync {
    /// Targets may be written from here on; `None` = at once.
    pub wait: Option<(vk::Semaphore, u64)>,
    /// Reached when all targets are written; `None` = the call waits until they are.
    pub signal: Option<(vk::Semaphore, u64)>,
}

/// A delivery under way. It keeps its sources; dropping it waits until the device is done with
/// them.
pub struct Delivery {
    device: Device,
    pool: vk::CommandPool,
    fence: vk::Fence,
    submitted: bool,
    _sources: Vec<Buffer>,
}

impl Device {
    /// Copies whole buffers to targets of the host, ordered by timeline semaphores. The targets
    /// belong to the queue family of the device when the copy begins, and still do when it ends.
    ///
    /// # Safety
    /// Every target is alive until the copy has ended, has the usage that [`Target`] names, is as
    /// large as its source (images: `size` × `layers` texels of the source's texel size), and is on
    /// this device.
    pub unsafe fn deliver(&self, copies: Vec<(Buffer, Target)>, sync: Sync) -> Result<Delivery> {
        if self.0.owned {
            return Err(Error::Host(
                "targets on the device need a context on the host's own Vulkan device: buffers of another device cannot be written"
                    .to_owned(),
            ));
        }
        if (sync.wait.is_some() || sync.signal.is_some()) && !self.0.timeline {
            return Err(Error::Host(
                "timeline semaphores are off; make the Vulkan device with timelineSemaphore".to_owned(),
            ));
        }
        self.flush()?;
        let error = || vk_error("delivering to the host");
        let device = &self.0.device;
        let pool = vk::CommandPoolCreateInfo::default().queue_family_index(self.0.queue_family);
        // SAFETY: plain object creation on a live device.
        let pool = unsafe { device.create_command_pool(&pool, None) }.map_err(error())?;
        let mut delivery = Delivery {
            device: self.clone(),
            pool,
            fence: vk::Fence::null(),
            submitted: false,
            _sources: copies.iter().map(|(b, _)| b.clone()).collect(),
        };
        // SAFETY: as above; from here on Drop cleans up.
        delivery.fence =
            unsafe { device.create_fence(&vk::FenceCreateInfo::default(), None) }.map_err(error())?;
        let commands = self.delivery_commands(pool, &copies)?;
        self.submit_ordered(commands, delivery.fence, sync).map_err(error())?;
        delivery.submitted = true;
        if sync.signal.is_none() {
            delivery.wait()?;
        }
        Ok(delivery)
    }

    fn delivery_commands(
        &self,
        pool: vk::CommandPool,
        copies: &[(Buffer, Target)],
    ) -> Result<vk::CommandBuffer> {
        let error = || vk_error("delivering to the host");
        let device = &self.0.device;
        let allocate = vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
        // SAFETY: the pool is ours and alive.
        let made = unsafe { device.allocate_command_buffers(&allocate) }.map_err(error())?;
        let commands = made.first().copied().unwrap_or_default();
        let begin = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: freshly allocated.
        unsafe { device.begin_command_buffer(commands, &begin) }.map_err(error())?;
        self.cmd_edge_barrier(commands);
        self.cmd_layouts(commands, copies, false);
        for (from, target) in copies {
            // SAFETY: recording; sources are kept by the delivery, targets are valid per the
            // contract of `deliver`.
            unsafe {
                match *target {
                    Target::Buffer { raw, offset } => {
                        let region = [vk::BufferCopy::default().dst_offset(offset).size(from.bytes())];
                        device.cmd_copy_buffer(commands, from.raw(), raw, &region);
                    }
                    Target::Image { raw, size, layers, .. } => {
                        let region = [vk::BufferImageCopy::default()
                            .image_subresource(
                                vk::ImageSubresourceLayers::default()
                                    .aspect_mask(vk::ImageAspectFlags::COLOR)
                                    .layer_count(layers),
                            )
                            .image_extent(vk::Extent3D { width: size[0], height: size[1], depth: 1 })];
                        let layout = vk::ImageLayout::TRANSFER_DST_OPTIMAL;
                        device.cmd_copy_buffer_to_image(commands, from.raw(), raw, layout, &region);
                    }
                }
            }
        }
        self.cmd_layouts(commands, copies, true);
        self.cmd_edge_barrier(commands);
        // SAFETY: recording.
        unsafe { device.end_command_buffer(commands) }.map_err(error())?;
        Ok(commands)
    }

    /// Image layouts before (to TRANSFER_DST) and after the copies.
    fn cmd_layouts(&self, commands: vk::CommandBuffer, copies: &[(Buffer, Target)], after: bool) {
        let barrier = |(_, target): &(Buffer, Target)| {
            let Target::Image { raw, layers, before, after: last, .. } = *target else { return None };
            let range = vk::ImageSubresourceRange::default()
                .aspect_mask(vk::ImageAspectFlags::COLOR)
                .level_count(1)
                .layer_count(layers);
            let b = vk::ImageMemoryBarrier2::default()
                .src_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
                .dst_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
                .image(raw)
                .subresource_range(range);
            let (copy, all) = (vk::PipelineStageFlags2::ALL_TRANSFER, vk::PipelineStageFlags2::ALL_COMMANDS);
            let written = vk::AccessFlags2::TRANSFER_WRITE;
            let any = vk::AccessFlags2::MEMORY_READ | vk::AccessFlags2::MEMORY_WRITE;
            let middle = vk::ImageLayout::TRANSFER_DST_OPTIMAL;
            Some(if after {
                b.src_stage_mask(copy)
                    .src_access_mask(written)
                    .dst_stage_mask(all)
                    .dst_access_mask(any)
                    .old_layout(middle)
                    .new_layout(last)
            } else {
                b.src_stage_mask(all)
                    .src_access_mask(vk::AccessFlags2::MEMORY_WRITE)
                    .dst_stage_mask(copy)
                    .dst_access_mask(written)
                    .old_layout(before)
                    .new_layout(middle)
            })
        };
        let barriers: Vec<_> = copies.iter().filter_map(barrier).collect();
        if !barriers.is_empty() {
            self.cmd_barrier(commands, &vk::DependencyInfo::default().image_memory_barriers(&barriers));
        }
    }

    fn submit_ordered(
        &self,
        commands: vk::CommandBuffer,
        fence: vk::Fence,
        sync: Sync,
    ) -> std::result::Result<(), vk::Result> {
        let (wait, signal): (Vec<_>, Vec<_>) =
            (sync.wait.into_iter().collect(), sync.signal.into_iter().collect());
        let (waits, wait_values): (Vec<_>, Vec<_>) = wait.into_iter().unzip();
        let (signals, signal_values): (Vec<_>, Vec<_>) = signal.into_iter().unzip();
        // Earlier commands read only our own memory, but keeping it behind the
        // wait costs nothing.
        let stages = vec![vk::PipelineStageFlags::ALL_COMMANDS; waits.len()];
        let mut timeline = vk::TimelineSemaphoreSubmitInfo::default()
            .wait_semaphore_values(&wait_values)
            .signal_semaphore_values(&signal_values);
        let commands = [commands];
        let mut info = vk::SubmitInfo::default()
            .command_buffers(&commands)
            .wait_semaphores(&waits)
            .wait_dst_stage_mask(&stages)
            .signal_semaphores(&signals);
        if !waits.is_empty() || !signals.is_empty() {
            info = info.push_next(&mut timeline);
        }
        self.queue_submit(&[info], fence)
    }
}

impl Delivery {
    /// Whether all targets are written.
    pub fn finished(&self) -> bool {
        // SAFETY: the fence was submitted. A lost device is finished, too.
        !self.submitted || !matches!(unsafe { self.device.0.device.get_fence_status(self.fence) }, Ok(false))
    }

    /// Waits until all targets are written.
    pub fn wait(&self) -> Result<()> {
        if !self.submitted {
            return Ok(());
        }
        // SAFETY: the fence was submitted.
        unsafe { self.device.0.device.wait_for_fences(&[self.fence], true, u64::MAX) }
            .map_err(vk_error("delivering to the host"))
    }
}

impl Drop for Delivery {
    fn drop(&mut self) {
        // A lost device ends the wait with an error, and nothing runs on it any more.
        let _ = self.wait();
        let device = &self.device.0.device;
        // SAFETY: nothing is pending; null handles are allowed.
        unsafe {
            device.destroy_fence(self.fence, None);
            device.destroy_command_pool(self.pool, None);
        }
    }
}
