//! Memory at a fixed address that a C library writes to.
//! It does not synchronise anything: its owner decides when the library may write.

use std::cell::Cell;
use std::ptr;

/// Values whose addresses stay the same, even when this struct is moved.
///
/// A `Vec` keeps its elements where they are, and what is in a `Cell` may be written through other pointers.
pub(crate) struct Pinned<T>(Vec<Cell<T>>);

impl<T: Copy> Pinned<T> {
    /// `len` values, all `value`.
    pub(crate) fn new(value: T, len: usize) -> Pinned<T> {
        Pinned(vec![Cell::new(value); len])
    }

    /// The address of element `index`, followed by the later elements, for the library to keep.
    pub(crate) fn address(&self, index: usize) -> *mut T {
        self.0[index..].as_ptr().cast_mut().cast()
    }

    /// The values.
    ///
    /// # Safety
    /// The library must not write to this memory while the reference is alive.
    pub(crate) unsafe fn as_slice(&self) -> &[T] {
        // SAFETY: a `Cell<T>` lies in memory as a `T`; the caller guarantees that the library does not write, and `write` needs
        // `&mut self`.
        unsafe { &*(ptr::from_ref(self.0.as_slice()) as *const [T]) }
    }

    /// Writes all values; the library must not be reading them.
    pub(crate) fn write(&mut self, values: &[T]) {
        for (cell, &value) in self.0.iter().zip(values) {
            cell.set(value);
        }
    }
}
