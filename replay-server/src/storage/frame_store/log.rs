//! Bytes that come at one end and go at the other, in segments of one size, so that memory cannot fragment.

use std::{collections::VecDeque, ops::Range};

const SEGMENT_BYTES: usize = 1 << 20;
/// Most that a log holds beyond its contents: three segments.
pub(crate) const OVERHEAD_BYTES_MAX: u64 = 3 * SEGMENT_BYTES as u64;

/// A queue of bytes; every byte has a place, counted since the start.
#[derive(Default)]
pub(crate) struct Log {
    start: u64,
    end: u64,
    /// Those in which `start..end` lies, the oldest first; contents may run from one into the next.
    segments: VecDeque<Box<[u8]>>,
    /// One that became empty, for the next that is needed; further ones go back to the system.
    spare: Option<Box<[u8]>>,
}

impl Log {
    /// Adds bytes at the end and gives where they begin.
    pub(crate) fn append(&mut self, mut bytes: &[u8]) -> u64 {
        let begin = self.end;
        while !bytes.is_empty() {
            let (segment, offset) = self.locate(self.end);
            if segment == self.segments.len() {
                let empty = || vec![0; SEGMENT_BYTES].into_boxed_slice();
                let segment = self.spare.take().unwrap_or_else(empty);
                self.segments.push_back(segment);
            }
            let (now, rest) = bytes.split_at(bytes.len().min(SEGMENT_BYTES - offset));
            self.segments[segment][offset..][..now.len()].copy_from_slice(now);
            self.end += now.len() as u64;
            bytes = rest;
        }
        begin
    }

    /// Drops everything before `start`.
    pub(crate) fn release(&mut self, start: u64) {
        assert!(
            (self.start..=self.end).contains(&start),
            "{start} lies in {}..{}",
            self.start,
            self.end
        );
        let (emptied, _) = self.locate(start);
        self.start = start;
        if let Some(segment) = self.segments.drain(..emptied).next_back() {
            self.spare = Some(segment);
        }
    }

    /// Copies the bytes of a place to the end of `out`.
    pub(crate) fn copy(&self, place: Range<u64>, out: &mut Vec<u8>) {
        let mut at = place.start;
        while at < place.end {
            let (segment, offset) = self.locate(at);
            let length = (SEGMENT_BYTES - offset).min((place.end - at) as usize);
            out.extend_from_slice(&self.segments[segment][offset..][..length]);
            at += length as u64;
        }
    }

    /// Segment and offset of a place.
    fn locate(&self, at: u64) -> (usize, usize) {
        let segment = |at| at / SEGMENT_BYTES as u64;
        (
            (segment(at) - segment(self.start)) as usize,
            (at % SEGMENT_BYTES as u64) as usize,
        )
    }

    /// Where the contents begin.
    pub(crate) const fn start(&self) -> u64 {
        self.start
    }

    pub(crate) const fn len(&self) -> u64 {
        self.end - self.start
    }

    pub(crate) fn bytes_held(&self) -> u64 {
        ((self.segments.len() + usize::from(self.spare.is_some())) * SEGMENT_BYTES) as u64
    }
}
