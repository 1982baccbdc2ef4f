//! Frames as they came, in one buffer: number `i` since the start lies in slot `(i - first) % capacity`.

/// The newest `capacity` frames.
pub(crate) struct PlainFrames {
    capacity: u64,
    frame_bytes: usize,
    first: u64,
    /// Where the next frame goes.
    next: usize,
    /// Grows into its reservation, so that memory is taken only as transitions come.
    bytes: Vec<u8>,
}

impl PlainFrames {
    /// An empty buffer for `capacity` frames. An error gives the bytes that the system refuses to reserve.
    pub(crate) fn new(capacity: u64, frame_bytes: usize) -> Result<Self, u64> {
        let asked = capacity.saturating_mul(frame_bytes as u64);
        let length = usize::try_from(asked).map_err(|_| asked)?;
        let mut bytes = Vec::new();
        bytes.try_reserve_exact(length).map_err(|_| asked)?;
        Ok(Self {
            capacity,
            frame_bytes,
            first: 0,
            next: 0,
            bytes,
        })
    }

    /// Lets go of all frames; the next one has the number `first`.
    pub(crate) fn start_at(&mut self, first: u64) {
        self.bytes.clear();
        (self.first, self.next) = (first, 0);
    }

    /// Stores frames, over the oldest ones once the buffer is full.
    pub(crate) fn push(&mut self, mut frames: &[u8]) {
        let capacity_bytes = self.capacity as usize * self.frame_bytes;
        while !frames.is_empty() {
            let (now, rest) = frames.split_at(frames.len().min(capacity_bytes - self.next));
            if self.next == self.bytes.len() {
                self.bytes.extend_from_slice(now);
            } else {
                self.bytes[self.next..][..now.len()].copy_from_slice(now);
            }
            self.next = (self.next + now.len()) % capacity_bytes;
            frames = rest;
        }
    }

    /// Frame `index`, which must be held.
    pub(crate) fn frame(&self, index: u64) -> &[u8] {
        let at = ((index - self.first) % self.capacity) as usize * self.frame_bytes;
        &self.bytes[at..at + self.frame_bytes]
    }

    pub(crate) fn bytes_held(&self) -> u64 {
        self.bytes.len() as u64
    }

    pub(crate) fn check_valid(&self, stored: u64) {
        // One frame a transition, until they are overwritten.
        let bytes = stored.min(self.capacity) * self.frame_bytes as u64;
        assert_eq!(self.bytes_held(), bytes);
    }
}
