//! Writes of several threads to one buffer.
use std::marker::PhantomData;

/// A slice whose elements are each used by one thread.
pub(super) struct Scattered<'a, T> {
    first: *mut T,
    len: usize,
    slice: PhantomData<&'a mut [T]>,
}

// SAFETY: callers of `get` and `set` use different places.
unsafe impl<T: Send> Sync for Scattered<'_, T> {}

impl<'a, T: Copy> Scattered<'a, T> {
    pub fn new(slice: &'a mut [T]) -> Scattered<'a, T> {
        Scattered { first: slice.as_mut_ptr(), len: slice.len(), slice: PhantomData }
    }

    /// An element; a default behind the end.
    ///
    /// # Safety
    /// That of [`Scattered::set`].
    pub unsafe fn get(&self, index: usize) -> T
    where
        T: Default,
    {
        // SAFETY: within the slice; see the contract.
        if index < self.len { unsafe { *self.first.add(index) } } else { T::default() }
    }

    /// Replaces an element; nothing behind the end.
    ///
    /// # Safety
    /// No other thread uses the same `index` while this slice is borrowed.
    pub unsafe fn set(&self, index: usize, value: T) {
        if index < self.len {
            // SAFETY: within the slice, which is borrowed mutably; see the contract.
            unsafe { *self.first.add(index) = value };
        }
    }

    /// Replaces consecutive elements, beginning at `first`; none where one is behind the end.
    ///
    /// # Safety
    /// That of [`Scattered::set`], for each of them.
    pub unsafe fn set_all(&self, first: usize, values: &[T]) {
        if first + values.len() <= self.len {
            // SAFETY: within the slice, which is borrowed mutably; see the contract.
            unsafe { self.first.add(first).copy_from_nonoverlapping(values.as_ptr(), values.len()) };
        }
    }
}
