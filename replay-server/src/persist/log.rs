//! The log of a replay that is in use: its chunks, and its marks with the segments that these need.
//! How a record is written is for `journal`, and what a snapshot holds for `snapshot`.

use std::collections::VecDeque;

use super::{
    error::PersistError, folder::LogFolder, journal::Journal, segment::Mark, snapshot::Snapshot,
};
use crate::storage::frame_store::PackedChunk;

/// Marks that hold: if the newest is of a checkpoint that was not written whole, the one before it is wanted.
const MARKS: usize = 2;

/// The log of a replay.
pub(crate) struct Log {
    pub(crate) journal: Journal,
    /// Of the run whose chunks it holds.
    pub(crate) spec_hash: u64,
    /// The last two marks that were not given up, the newest last.
    pub(super) marks: VecDeque<Marked>,
    pub(super) _folder: LogFolder,
}

/// A moment to which a replay can go back: what it needs stays in the log.
#[derive(Clone, Copy, Debug)]
pub(super) struct Marked {
    pub(super) mark: Mark,
    /// The oldest transition that was held.
    pub(super) oldest_row: u64,
}

impl Log {
    /// Writes a chunk that is to be stored; `false`: the disk refuses, and it must not be. The error says why it makes no message.
    pub(crate) fn chunk(&mut self, packed: &PackedChunk<'_>) -> Result<bool, String> {
        let chunk = &packed.chunk;
        match &packed.sealed {
            Some(Ok(head)) => Ok(self.journal.append_chunk(head, chunk.payload())),
            Some(Err(e)) => Err(e.to_string()),
            None => chunk
                .seal(self.spec_hash)
                .map(|(head, payload)| self.journal.append_chunk(&head, payload))
                .map_err(|e| e.to_string()),
        }
    }

    /// Begins another segment, which is on the disk when this returns and stays.
    pub(crate) fn mark(&mut self, snapshot: Snapshot) -> Result<Mark, PersistError> {
        let oldest_row = snapshot.oldest;
        let mark = self.journal.mark(&snapshot)?;
        if self.marks.len() == MARKS {
            self.marks.pop_front();
        }
        self.marks.push_back(Marked { mark, oldest_row });
        Ok(mark)
    }

    /// Nothing will go back to `mark`.
    pub(crate) fn give_up(&mut self, mark: Mark) {
        self.marks.retain(|it| it.mark != mark);
    }

    /// Removes the segments that neither the ring, whose oldest transition is `oldest_row`, nor a mark needs.
    pub(crate) fn prune(&mut self, oldest_row: u64) {
        let (oldest, keep) = match self.marks.front() {
            Some(first) => (oldest_row.min(first.oldest_row), first.mark.segment()),
            None => (oldest_row, u64::MAX),
        };
        self.journal.prune(oldest, keep);
    }
}
