//! Reusable memory for the long payloads of messages, shared with the other side if both are on one host.
//! The content is not known here, and messages are sent alike from private and from shared memory.
//!
//! Fresh memory costs a page fault every 4 KiB, more than filling it. Shared memory avoids the copy through a socket, but a receiver may
//! lose it: zenoh reclaims it from a process that seems dead. So receivers copy before they check.

use std::{
    fmt,
    ops::{Deref, DerefMut},
    sync::{Arc, Mutex},
};

use zenoh::{
    Wait,
    bytes::ZBytes,
    shm::{
        Defragment, GarbageCollect, PosixShmProviderBackend, ShmBuf, ShmProvider,
        ShmProviderBuilder, ZShmMut,
    },
};

use super::shared_memory::{self, METADATA_BYTES, Trust};
use crate::process::lock;

/// Memory for the payload of a message. A clone is a copy in new memory.
pub struct Buffer(Memory);

enum Memory {
    /// Private memory, which returns to the pool when dropped, if there is a pool.
    Private(Vec<u8>, Option<Arc<Pool>>),
    Shared(ZShmMut),
}

struct Pool {
    spare: Mutex<Vec<Vec<u8>>>,
    spare_max: usize,
    shared: Option<SharedMemory>,
}

struct SharedMemory {
    provider: ShmProvider<PosixShmProviderBackend>,
    trust: Mutex<Trust>,
}

/// A source of [`Buffer`]s; clones share one pool.
#[derive(Clone)]
pub struct BufferPool(Arc<Pool>);

impl BufferPool {
    /// Creates a pool of private memory, which keeps at most `spare_max` returned buffers for reuse.
    pub fn new(spare_max: usize) -> Self {
        Self::with_shared(spare_max, None)
    }

    /// Like [`BufferPool::new`], with shared memory for `count` buffers of `bytes` each. If the machine does not grant shared memory, a
    /// warning is logged and all buffers are private.
    pub fn shared(spare_max: usize, count: usize, bytes: usize) -> Self {
        let created = create_provider(shared_memory::pool_bytes(count, bytes));
        let shared = shared_memory::granted(created).map(|provider| SharedMemory {
            provider,
            trust: Mutex::default(),
        });
        Self::with_shared(spare_max, shared)
    }

    fn with_shared(spare_max: usize, shared: Option<SharedMemory>) -> Self {
        Self(Arc::new(Pool {
            spare: Mutex::default(),
            spare_max,
            shared,
        }))
    }

    /// Returns `bytes` bytes of private memory with arbitrary content.
    pub fn take_private(&self, bytes: usize) -> Buffer {
        let mut vec = lock(&self.0.spare).pop().unwrap_or_default();
        vec.resize(bytes, 0);
        Buffer(Memory::Private(vec, Some(self.0.clone())))
    }

    /// Returns `bytes` bytes with arbitrary content: shared memory if the pool has some and may use it, else private memory.
    pub fn take(&self, bytes: usize) -> Buffer {
        match self.0.shared.as_ref().and_then(|shared| shared.take(bytes)) {
            Some(shared) => Buffer(Memory::Shared(shared)),
            None => self.take_private(bytes),
        }
    }

    /// Reports that a message in shared memory did not arrive: the next ones use private memory.
    pub fn report_shared_loss(&self) {
        if let Some(shared) = &self.0.shared {
            lock(&shared.trust).record_loss();
        }
    }

    /// Reports that a message has arrived, through shared memory or not.
    pub fn report_arrival(&self, in_shared_memory: bool) {
        if let Some(shared) = &self.0.shared {
            lock(&shared.trust).record_arrival(in_shared_memory);
        }
    }
}

impl SharedMemory {
    /// Never waits. A killed receiver's buffers stay in use while this process runs: zenoh frees a buffer once all have released it.
    fn take(&self, bytes: usize) -> Option<ZShmMut> {
        if !lock(&self.trust).may_use() {
            return None;
        }
        let piece = self.provider.alloc(bytes);
        let taken = piece.with_policy::<Defragment<GarbageCollect>>().wait();
        lock(&self.trust).record_allocation(taken.is_ok());
        taken.ok()
    }
}

/// Creates a pool of `bytes` bytes of shared memory, or returns why it cannot.
///
/// zenoh creates its metadata at the first allocation and panics if it cannot, so that allocation happens here, while there is room. zenoh
/// locks all of this memory, so a folder that fills up later takes nothing from this process.
fn create_provider(bytes: usize) -> Result<ShmProvider<PosixShmProviderBackend>, String> {
    let needed = shared_memory::process_bytes(bytes);
    shared_memory::check_lockable(needed)?;
    shared_memory::check_file_size(bytes.max(METADATA_BYTES))?;
    shared_memory::allocate_in_turn(needed, || {
        let provider = ShmProviderBuilder::default_backend(bytes).wait();
        let provider = provider.map_err(|e| e.to_string())?;
        let first = provider.alloc(1).wait().map_err(|e| format!("{e:?}"))?;
        drop(first);
        Ok(provider)
    })
}

impl Buffer {
    /// Creates a buffer of `bytes` zeros outside any pool.
    pub fn zeroed(bytes: usize) -> Self {
        Self::from(vec![0; bytes])
    }

    /// Whether the bytes lie in shared memory, which other processes on this host can read.
    pub const fn is_shared(&self) -> bool {
        matches!(self.0, Memory::Shared(_))
    }

    /// Returns the bytes for sending, without a copy. Private memory returns to its pool when the last clone is dropped.
    pub fn freeze(mut self) -> ZBytes {
        match std::mem::replace(&mut self.0, Memory::Private(Vec::new(), None)) {
            Memory::Shared(shared) => ZBytes::from(shared),
            private => ZBytes::from(bytes::Bytes::from_owner(Self(private))),
        }
    }
}

/// Whether other processes can still read `payload`. zenoh writes off the shared memory of a process that seems dead, because its watchdog
/// thread got no processor for 100 ms. Receivers then drop messages in it without a warning, although this process can still read it.
pub fn is_readable(payload: &ZBytes) -> bool {
    payload.as_shm().is_none_or(|shared| shared.is_valid())
}

impl From<Vec<u8>> for Buffer {
    fn from(bytes: Vec<u8>) -> Self {
        Self(Memory::Private(bytes, None))
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        if let Memory::Private(bytes, Some(pool)) = &mut self.0 {
            let mut spare = lock(&pool.spare);
            if spare.len() < pool.spare_max {
                spare.push(std::mem::take(bytes));
            }
        }
    }
}

impl Deref for Buffer {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match &self.0 {
            Memory::Private(bytes, _) => bytes,
            Memory::Shared(bytes) => bytes,
        }
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [u8] {
        match &mut self.0 {
            Memory::Private(bytes, _) => bytes,
            Memory::Shared(bytes) => bytes,
        }
    }
}

impl AsRef<[u8]> for Buffer {
    fn as_ref(&self) -> &[u8] {
        self
    }
}

impl Clone for Buffer {
    fn clone(&self) -> Self {
        Self::from(self.to_vec())
    }
}

impl PartialEq for Buffer {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl fmt::Debug for Buffer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Buffer({} bytes)", self.len())
    }
}

impl fmt::Debug for BufferPool {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("BufferPool").finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_memory_comes_back_also_from_the_wire() {
        let pool = BufferPool::new(1);
        let mut payload = pool.take_private(5);
        payload.copy_from_slice(b"abcde");
        let address = payload.as_ptr();
        let (sent, again) = (payload.freeze(), pool.take_private(5));
        assert_ne!(again.as_ptr(), address);
        assert_eq!(sent.to_bytes(), &b"abcde"[..]);
        drop((sent.clone(), again, sent));
        // The pool keeps one buffer, the first that came back.
        assert_eq!(pool.0.spare.lock().unwrap().len(), 1);
        assert_eq!(pool.take_private(3).len(), 3);
    }

    #[test]
    fn zenoh_s_own_part_is_made_with_the_pool_and_is_as_long_as_reckoned() {
        let pool = BufferPool::shared(1, 1, 1 << 12);
        let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
        let segments = maps.lines().filter(|line| line.ends_with(".zenoh"));
        let lens = segments.map(|line| {
            let (from, to) = line.split_once(' ').unwrap().0.split_once('-').unwrap();
            let address = |hex| usize::from_str_radix(hex, 16).unwrap();
            address(to) - address(from)
        });
        let lens: Vec<_> = lens.collect();
        // Unless this machine grants no shared memory.
        assert!(
            pool.0.shared.is_none() || lens.contains(&METADATA_BYTES),
            "{lens:?}"
        );
    }

    #[test]
    fn shared_memory_is_avoided_after_a_loss_and_never_waited_for() {
        let pool = BufferPool::shared(4, 2, 1_000_000);
        if pool.0.shared.is_none() {
            // Without shared memory, all buffers are private.
            assert!(!pool.take(1_000_000).is_shared());
            return;
        }
        let pieces: Vec<_> = (0..8).map(|_| pool.take(1_000_000)).collect();
        assert!(pieces[0].is_shared() && pieces[1].is_shared() && !pieces[7].is_shared());
        drop(pieces);
        pool.report_shared_loss();
        assert!(!pool.take(1_000_000).is_shared());
        while !pool.take(1_000_000).is_shared() {
            pool.report_arrival(false);
        }
        pool.report_shared_loss();
        assert!(!pool.take(1_000_000).is_shared());
    }
}
