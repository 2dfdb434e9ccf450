//! Counted work of a device: operations that cost time on every machine.
use crate::device::Device;
use std::ops::Sub;
use std::sync::atomic::{AtomicU64, Ordering};

/// Work of a device since it was opened; the difference of two is the work in between.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct WorkCounts {
    /// Submissions to the queue: a call of the driver each, and nearly always a wait.
    pub submissions: u64,
    /// Buffers made.
    pub allocations: u64,
    /// Reads of buffers by the host.
    pub reads: u64,
    /// Bytes of these reads.
    pub bytes_read: u64,
    /// Bytes that the host wrote to buffers.
    pub bytes_written: u64,
}

impl Sub for WorkCounts {
    type Output = WorkCounts;

    fn sub(self, earlier: WorkCounts) -> WorkCounts {
        WorkCounts {
            submissions: self.submissions - earlier.submissions,
            allocations: self.allocations - earlier.allocations,
            reads: self.reads - earlier.reads,
            bytes_read: self.bytes_read - earlier.bytes_read,
            bytes_written: self.bytes_written - earlier.bytes_written,
        }
    }
}

/// Transfers between host and device so far.
#[derive(Default)]
pub(crate) struct Transfers {
    reads: AtomicU64,
    bytes_read: AtomicU64,
    bytes_written: AtomicU64,
}

impl Transfers {
    pub fn read(&self, bytes: u64) {
        self.reads.fetch_add(1, Ordering::Relaxed);
        self.bytes_read.fetch_add(bytes, Ordering::Relaxed);
    }

    pub fn written(&self, bytes: u64) {
        self.bytes_written.fetch_add(bytes, Ordering::Relaxed);
    }
}

impl Device {
    /// Work of the device so far.
    pub fn work(&self) -> WorkCounts {
        let Transfers { reads, bytes_read, bytes_written } = &self.0.transfers;
        WorkCounts {
            submissions: self.submissions(),
            allocations: self.memory().allocations,
            reads: reads.load(Ordering::Relaxed),
            bytes_read: bytes_read.load(Ordering::Relaxed),
            bytes_written: bytes_written.load(Ordering::Relaxed),
        }
    }
}
