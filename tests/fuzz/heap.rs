//! An allocator that counts bytes.
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Currently allocated bytes, and their peak.
pub struct Heap {
    now: AtomicUsize,
    peak: AtomicUsize,
}

impl Heap {
    pub const fn new() -> Heap {
        Heap { now: AtomicUsize::new(0), peak: AtomicUsize::new(0) }
    }

    /// Resets the peak; returns the currently allocated bytes as the base.
    pub fn mark(&self) -> usize {
        let now = self.now.load(Relaxed);
        self.peak.store(now, Relaxed);
        now
    }

    /// Peak since the mark, above it, bytes.
    pub fn peak_above(&self, mark: usize) -> usize {
        self.peak.load(Relaxed).saturating_sub(mark)
    }

    fn add(&self, bytes: usize) {
        let now = self.now.fetch_add(bytes, Relaxed) + bytes;
        self.peak.fetch_max(now, Relaxed);
    }
}

// SAFETY: forwards everything to the system's allocator and only keeps sums.
unsafe impl GlobalAlloc for Heap {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        self.add(layout.size());
        // SAFETY: the caller's own layout.
        unsafe { System.alloc(layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        self.add(layout.size());
        // SAFETY: the caller's own layout.
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        self.now.fetch_sub(layout.size(), Relaxed);
        // SAFETY: the caller's own pointer and layout.
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // Both may exist while the content is copied.
        self.add(size);
        self.now.fetch_sub(layout.size(), Relaxed);
        // SAFETY: the caller's own pointer, layout and size.
        unsafe { System.realloc(pointer, layout, size) }
    }
}
