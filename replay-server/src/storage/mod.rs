//! The storage of the replay: the transitions in a ring, and their frames, plain or compressed.
//! Nothing here draws samples or knows which actor sent a transition.

pub(crate) mod frame_store;
pub(crate) mod pack;
pub(crate) mod ring;

/// Reserves an empty vector for `count` values; the system provides memory only as values are written. An error holds the bytes that the
/// system does not grant.
pub(crate) fn reserve<T>(count: u64) -> Result<Vec<T>, u64> {
    let bytes = count.saturating_mul(size_of::<T>() as u64);
    let mut values = Vec::new();
    let reserved = values.try_reserve_exact(usize::try_from(count).unwrap_or(usize::MAX));
    reserved.map(|()| values).map_err(|_| bytes)
}
