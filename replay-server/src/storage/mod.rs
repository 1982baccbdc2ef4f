//! What the replay holds: the transitions in a ring, and their frames, plain or compressed.
//! Nothing here draws a sample or knows which actor sent what.

pub(crate) mod frame_store;
pub(crate) mod pack;
pub(crate) mod ring;

/// An empty vector with room for `count` values, of which memory is taken only as they come. An error gives the bytes that the system
/// refuses to reserve.
pub(crate) fn reserve<T>(count: u64) -> Result<Vec<T>, u64> {
    let asked = count.saturating_mul(size_of::<T>() as u64);
    let mut values = Vec::new();
    let reserved = values.try_reserve_exact(usize::try_from(count).unwrap_or(usize::MAX));
    reserved.map(|()| values).map_err(|_| asked)
}
