//! Recycled memory: buffers that return to a pool instead of the allocator.
//! Fresh memory costs a page fault every 4 KiB, which would take a third of a forward pass.

use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, PoisonError};

use half::bf16;

/// Alignment of a buffer in bytes: one cache line. AMX takes six times as long for rows that cross cache lines.
pub(crate) const ALIGNMENT: usize = 64;
/// Largest number of free buffers in each type's pool. Beyond it, the smallest one returns to the allocator.
const POOL_LEN_MAX: usize = 1024;

/// A scalar type with a buffer pool.
pub(crate) trait Pooled: Copy + Default + 'static {
    /// Returns the type's pool, in ascending order of capacity.
    fn pool() -> &'static Mutex<Vec<Vec<Self>>>;
}

macro_rules! pooled {
    ($($scalar:ty)*) => {$(
        impl Pooled for $scalar {
            fn pool() -> &'static Mutex<Vec<Vec<Self>>> {
                static POOL: Mutex<Vec<Vec<$scalar>>> = Mutex::new(Vec::new());
                &POOL
            }
        }
    )*};
}

pooled!(f32 bf16 u8);

/// A slice of memory from the pool, which returns there when dropped.
pub(crate) struct Buffer<T: Pooled> {
    memory: Vec<T>,
    /// Index in `memory` of the first scalar at a multiple of `ALIGNMENT`.
    start: usize,
    len: usize,
}

impl<T: Pooled> Buffer<T> {
    /// Takes a buffer of `len` scalars with arbitrary old content.
    pub(crate) fn new(len: usize) -> Self {
        let min_len = len + ALIGNMENT / size_of::<T>();
        let mut pool = T::pool().lock().unwrap_or_else(PoisonError::into_inner);
        let index = pool.partition_point(|memory| memory.len() < min_len);
        let memory = (index < pool.len()).then(|| pool.remove(index));
        drop(pool);
        // A little larger than requested, so that it also serves slightly longer requests.
        let memory = memory.unwrap_or_else(|| vec![T::default(); min_len + len / 8]);
        let start = memory.as_ptr().align_offset(ALIGNMENT);
        Self { memory, start, len }
    }

    /// Takes a buffer of `len` zeros.
    pub(crate) fn zeros(len: usize) -> Self {
        let mut buffer = Self::new(len);
        buffer.fill(T::default());
        buffer
    }
}

impl<T: Pooled> Deref for Buffer<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.memory[self.start..][..self.len]
    }
}

impl<T: Pooled> DerefMut for Buffer<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.memory[self.start..][..self.len]
    }
}

impl<T: Pooled> Drop for Buffer<T> {
    fn drop(&mut self) {
        let memory = std::mem::take(&mut self.memory);
        let mut pool = T::pool().lock().unwrap_or_else(PoisonError::into_inner);
        let index = pool.partition_point(|free| free.len() < memory.len());
        pool.insert(index, memory);
        if pool.len() > POOL_LEN_MAX {
            // The smallest is the cheapest to allocate again.
            drop(pool.remove(0));
        }
    }
}

/// Scalars borrowed in place, or a copy.
pub(crate) enum Scalars<'a, T: Pooled> {
    InPlace(&'a [T]),
    Copied(Buffer<T>),
}

impl<T: Pooled> Deref for Scalars<'_, T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        match self {
            Self::InPlace(scalars) => scalars,
            Self::Copied(scalars) => scalars,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_has_the_length_that_was_asked_for_whatever_was_there_before() {
        for len in [5, 3, 8, 0, 100, 7] {
            let mut buffer = Buffer::<f32>::new(len);
            assert_eq!(buffer.len(), len);
            assert_eq!(buffer.as_ptr() as usize % ALIGNMENT, 0);
            buffer.fill(7.0);
        }
        assert!(Buffer::<f32>::zeros(50).iter().all(|&value| value == 0.0));
    }
}
