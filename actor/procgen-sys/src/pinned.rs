//! Memory at a fixed address that a C library writes to.
//! It does not synchronise anything: its owner says when the library may write.

use std::ptr::NonNull;

/// A slice that never moves or grows while it is alive, even when the value holding it moves.
///
/// A `Box` does not work: moving one asserts that no other pointer into it exists, and the engine has one.
pub(crate) struct Pinned<T> {
    slice: NonNull<[T]>,
}

impl<T: Copy> Pinned<T> {
    /// `len` values, all `value`.
    pub(crate) fn new(value: T, len: usize) -> Pinned<T> {
        let slice = Box::leak(vec![value; len].into_boxed_slice());
        Pinned {
            slice: NonNull::from(slice),
        }
    }

    /// Address of element `index`, for the library to keep.
    pub(crate) fn address(&self, index: usize) -> *mut T {
        let len = self.slice.len();
        assert!(index < len, "address of element {index} of {len}");
        // SAFETY: the index was just checked, so the address lies within the allocation.
        unsafe { self.slice.cast::<T>().as_ptr().add(index) }
    }

    /// The values.
    ///
    /// # Safety
    /// The library must not write to this memory while the reference is alive.
    pub(crate) unsafe fn as_slice(&self) -> &[T] {
        // SAFETY: the allocation lives as long as `self`; the caller guarantees that nothing writes to it.
        unsafe { self.slice.as_ref() }
    }

    /// The values, to write to.
    ///
    /// # Safety
    /// The library must neither read nor write this memory while the reference is alive.
    pub(crate) unsafe fn as_mut_slice(&mut self) -> &mut [T] {
        // SAFETY: as in `as_slice`, and `&mut self` keeps out other references made here.
        unsafe { self.slice.as_mut() }
    }
}

impl<T> Drop for Pinned<T> {
    fn drop(&mut self) {
        // SAFETY: the pointer came from `Box::leak` in `new` and is freed only here.
        drop(unsafe { Box::from_raw(self.slice.as_ptr()) });
    }
}

// SAFETY: a `Pinned` owns its values as a `Box` does; its address has no tie to a thread.
unsafe impl<T: Send> Send for Pinned<T> {}
