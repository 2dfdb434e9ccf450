//! Derived barriers as Vulkan takes them.
use crate::hazard::{AccessStage, Barrier, StageMasks};
use ash::vk;

/// A derived barrier on its buffer.
pub(crate) fn of(barrier: &Barrier, buffer: vk::Buffer) -> vk::BufferMemoryBarrier2<'static> {
    vk::BufferMemoryBarrier2::default()
        .src_stage_mask(stages(barrier.from))
        .src_access_mask(accesses(StageMasks { reads: 0, writes: barrier.from.writes }))
        .dst_stage_mask(stages(barrier.to))
        .dst_access_mask(accesses(barrier.to))
        .src_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
        .dst_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
        .buffer(buffer)
        .size(vk::WHOLE_SIZE)
}

const STAGES: [AccessStage; 3] = [AccessStage::Compute, AccessStage::Transfer, AccessStage::Indirect];

fn stages(scope: StageMasks) -> vk::PipelineStageFlags2 {
    let mut flags = vk::PipelineStageFlags2::NONE;
    for stage in STAGES.into_iter().filter(|&s| (scope.reads | scope.writes) & s as u8 != 0) {
        flags |= match stage {
            AccessStage::Compute => vk::PipelineStageFlags2::COMPUTE_SHADER,
            AccessStage::Transfer => vk::PipelineStageFlags2::ALL_TRANSFER,
            AccessStage::Indirect => vk::PipelineStageFlags2::DRAW_INDIRECT,
        };
    }
    flags
}

fn accesses(scope: StageMasks) -> vk::AccessFlags2 {
    let mut flags = vk::AccessFlags2::NONE;
    for stage in STAGES {
        let (read, write) = match stage {
            AccessStage::Compute => {
                (vk::AccessFlags2::SHADER_STORAGE_READ, vk::AccessFlags2::SHADER_STORAGE_WRITE)
            }
            AccessStage::Transfer => (vk::AccessFlags2::TRANSFER_READ, vk::AccessFlags2::TRANSFER_WRITE),
            AccessStage::Indirect => (vk::AccessFlags2::INDIRECT_COMMAND_READ, vk::AccessFlags2::NONE),
        };
        if scope.reads & stage as u8 != 0 {
            flags |= read;
        }
        if scope.writes & stage as u8 != 0 {
            flags |= write;
        }
    }
    flags
}
