//! How the columns of a batch lie in its payload: which there are, how wide they are, and where each begins.
//! `Batch` documents what the values mean.

use std::ops::Range;

use super::{batch_frames::StackedFrames, batch_header::BatchHeader};

/// The columns of a batch, in the order in which they lie one after the other. Each has a value for every row; those of the
/// positives have one for every row of the first positive, then of the second, and so on. States that a row does not have are left out.
/// Where states are stacks of frames, each frame is there once, and the columns of states say which of them each is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Column {
    Frames,
    StatesT,
    StatesK,
    StatesN,
    NStepReturn,
    BootstrapDiscount,
    Action,
    NextAction,
    PositiveValid,
    K,
    Transition,
    Probability,
}

impl Column {
    /// All of them, in their order.
    pub(super) const ALL: [Self; 12] = [
        Self::Frames,
        Self::StatesT,
        Self::StatesK,
        Self::StatesN,
        Self::NStepReturn,
        Self::BootstrapDiscount,
        Self::Action,
        Self::NextAction,
        Self::PositiveValid,
        Self::K,
        Self::Transition,
        Self::Probability,
    ];

    const fn is_per_positive(self) -> bool {
        matches!(self, Self::StatesK | Self::PositiveValid | Self::K)
    }

    /// Whether it is there only where rows are drawn by priority.
    const fn is_of_priorities(self) -> bool {
        matches!(self, Self::Transition | Self::Probability)
    }

    pub(super) const fn is_of_states(self) -> bool {
        matches!(self, Self::StatesT | Self::StatesK | Self::StatesN)
    }

    /// Bytes of a value that is neither a state nor a frame.
    const fn scalar_bytes(self) -> usize {
        match self {
            Self::Frames | Self::StatesT | Self::StatesK | Self::StatesN => 0,
            Self::NStepReturn | Self::BootstrapDiscount | Self::Probability => size_of::<f32>(),
            Self::Transition => size_of::<u64>(),
            Self::Action | Self::NextAction | Self::PositiveValid | Self::K => size_of::<u8>(),
        }
    }
}

impl BatchHeader {
    /// Bytes of all columns; none if they are more than the address space, if there are more states than rows can have, or if
    /// states are no stacks of the frames.
    pub(super) fn bytes(&self) -> Option<usize> {
        let positives = u64::from(self.rows) * u64::from(self.positives);
        let states = self.states().try_into().ok()?;
        let fits = u64::from(self.states_k) <= positives
            && self.states_n <= self.rows
            && self
                .stacked
                .is_none_or(|it| it.fit(states, self.state_bytes as usize));
        let bytes = || Column::ALL.iter().map(|&column| self.column_bytes(column));
        fits.then(|| bytes().sum::<u128>())
            .and_then(|it| it.try_into().ok())
    }

    fn states(&self) -> u64 {
        u64::from(self.rows) + u64::from(self.states_k) + u64::from(self.states_n)
    }

    /// Whether each row [B] bootstraps, in a payload whose scalars are written.
    pub(super) fn bootstraps(&self, payload: &[u8]) -> Vec<bool> {
        let (discounts, _) = payload[self.range(Column::BootstrapDiscount)].as_chunks();
        let bootstraps = |&discount: &[u8; 4]| f32::from_le_bytes(discount) != 0.0;
        discounts.iter().map(bootstraps).collect()
    }

    /// Whether each positive [P, B] is there, in a payload whose scalars are written.
    pub(super) fn positives_there(&self, payload: &[u8]) -> Vec<bool> {
        let valid = payload[self.range(Column::PositiveValid)].iter();
        valid.map(|&valid| valid != 0).collect()
    }

    /// The chance of each row [B], where rows are drawn by priority.
    pub(super) fn probabilities(&self, payload: &[u8]) -> impl Iterator<Item = f32> {
        let (chances, _) = payload[self.range(Column::Probability)].as_chunks();
        chances.iter().map(|&chance| f32::from_le_bytes(chance))
    }

    pub(super) fn of_states<'a>(&self, payload: &'a [u8]) -> &'a [u8] {
        &payload[self.range(Column::StatesT).start..self.range(Column::StatesN).end]
    }

    /// Bytes of a value in a column of states: all of a state, or what says of which frames it is made.
    pub(super) fn value_bytes(&self) -> usize {
        let stacked = self.stacked.as_ref();
        stacked.map_or(self.state_bytes as usize, StackedFrames::stack_bytes)
    }

    /// Frames that travel, and bytes of each: states where they are one frame.
    pub(super) fn frames(&self) -> (usize, usize) {
        let state_bytes = self.state_bytes as usize;
        match self.stacked {
            None => (self.states() as usize, state_bytes),
            Some(stacked) => (stacked.frames as usize, stacked.frame_bytes(state_bytes)),
        }
    }

    pub(super) const fn values_a_row(&self, column: Column) -> usize {
        if column.is_per_positive() {
            self.positives as usize
        } else {
            1
        }
    }

    /// Where states fit; of numbers of 32 bits, no three make an overflow.
    fn column_bytes(&self, column: Column) -> u128 {
        let product = |count: u32, a: usize, b: usize| u128::from(count) * a as u128 * b as u128;
        match column {
            Column::Frames => self
                .stacked
                .map_or(0, |stacked| product(stacked.frames, 1, self.frames().1)),
            Column::StatesT => product(self.rows, 1, self.value_bytes()),
            Column::StatesK => product(self.states_k, 1, self.value_bytes()),
            Column::StatesN => product(self.states_n, 1, self.value_bytes()),
            _ if column.is_of_priorities() && self.origin.is_none() => 0,
            _ => product(self.rows, self.values_a_row(column), column.scalar_bytes()),
        }
    }

    /// Where a column lies, in a payload of so many bytes.
    pub(super) fn range(&self, column: Column) -> Range<usize> {
        let bytes = |column: &Column| self.column_bytes(*column) as usize;
        let start = Column::ALL[..column as usize].iter().map(bytes).sum();
        start..start + bytes(&column)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::priorities::Origin;

    const FRAMES: StackedFrames = StackedFrames {
        frames: 5,
        frame_stack: 4,
        frame_channels: 1,
    };

    #[test]
    fn columns_fill_the_payload_without_gaps() {
        for (rows, positives, state_bytes, states_k, states_n) in [
            (1, 0, 1, 0, 0),
            (3, 1, 4, 2, 3),
            (256, 5, 12_288, 1200, 17),
            (256, 5, 12_288, 1280, 256),
        ] {
            let header = BatchHeader {
                rows,
                positives,
                state_bytes,
                states_k,
                states_n,
                origin: rows.is_multiple_of(2).then(Origin::default),
                stacked: state_bytes.is_multiple_of(4).then_some(FRAMES),
                ..BatchHeader::default()
            };
            let mut end = 0;
            for column in Column::ALL {
                let range = header.range(column);
                assert_eq!(range.start, end, "{column:?}");
                end = range.end;
            }
            assert_eq!(header.bytes(), Some(end));
        }
    }
}
