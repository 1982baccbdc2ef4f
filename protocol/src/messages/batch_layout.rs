//! How the columns of a batch lie in its payload: which there are, how wide they are, and where each begins.
//! `Batch` documents what the values mean.

use std::ops::Range;

use super::batch_frames::StackedFrames;

/// The columns of a batch, in the order in which they lie one after the other. Each has a value for every row; those of the
/// positives have one for every row of the first positive, then of the second, and so on. States that a row does not have are left out.
/// Where states are stacks of frames, each frame is there once, and the columns of states say which of them each is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Column {
    /// The frames of all states, where states are stacks of them.
    Frames,
    /// s_t, the state of the anchor.
    StatesT,
    /// s_{t+k}, of each positive.
    StatesK,
    /// s_{t+n}, from which the return bootstraps.
    StatesN,
    /// The n-step return, f32.
    NStepReturn,
    /// The discount of what is bootstrapped, f32.
    BootstrapDiscount,
    /// a_t, the action in it.
    Action,
    /// a_{t+1}, the action in the next state.
    NextAction,
    /// 1 where the row has this positive.
    PositiveValid,
    /// k of each positive.
    K,
    /// The transition's number since the start of the replay, u64; where rows are drawn by priority.
    Transition,
    /// The chance with which the row was drawn, f32; where rows are drawn by priority.
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

    /// Whether it has a value for each positive of a row.
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

/// Bytes of all scalars of a row itself, or of one of its positives; of those that every row has, or of those of priorities.
const fn scalar_bytes(per_positive: bool, of_priorities: bool) -> usize {
    let (mut bytes, mut at) = (0, 0);
    while at < Column::ALL.len() {
        let column = Column::ALL[at];
        assert!(
            column as usize == at,
            "the order of ALL is that of the columns"
        );
        if column.is_per_positive() == per_positive && column.is_of_priorities() == of_priorities {
            bytes += column.scalar_bytes();
        }
        at += 1;
    }
    bytes
}

const ROW_SCALAR_BYTES: usize = scalar_bytes(false, false);
const POSITIVE_SCALAR_BYTES: usize = scalar_bytes(true, false);
const PRIORITY_SCALAR_BYTES: usize = scalar_bytes(false, true);
const _: () =
    assert!(ROW_SCALAR_BYTES == 10 && POSITIVE_SCALAR_BYTES == 2 && PRIORITY_SCALAR_BYTES == 12);

/// The shape of a batch, from which the place of every value follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct BatchLayout {
    pub(super) rows: usize,
    /// Positives a row, P.
    pub(super) positives: usize,
    /// Bytes of one state.
    pub(super) state_bytes: usize,
    /// States s_{t+k} that are there, at most P for each row.
    pub(super) states_k: usize,
    /// States s_{t+n} that are there, at most one for each row.
    pub(super) states_n: usize,
    /// Whether rows say which transition they are and how likely they were.
    pub(super) is_prioritised: bool,
    /// The frames that states are stacks of; none where a state is one frame.
    pub(super) stacked: Option<StackedFrames>,
}

impl BatchLayout {
    /// Bytes of all columns; none if they are more than the address space, if there are more states than rows can have, or if
    /// states are no stacks of the frames.
    pub(super) fn bytes(&self) -> Option<usize> {
        let positives = self.rows.checked_mul(self.positives)?;
        if self.states_k > positives || self.states_n > self.rows {
            return None;
        }
        let states = self.rows.checked_add(self.states_k)?;
        let states = states.checked_add(self.states_n)?;
        let frames = match self.stacked {
            None => 0,
            Some(stacked) if stacked.fit(states, self.state_bytes) => {
                let frame_bytes = stacked.frame_bytes(self.state_bytes);
                frame_bytes.checked_mul(stacked.frames as usize)?
            }
            Some(_) => return None,
        };
        let states = states.checked_mul(self.value_bytes())?;
        let states = states.checked_add(frames)?;
        let of_priorities = if self.is_prioritised {
            PRIORITY_SCALAR_BYTES
        } else {
            0
        };
        let of_rows = self.rows.checked_mul(ROW_SCALAR_BYTES + of_priorities)?;
        let of_positives = positives.checked_mul(POSITIVE_SCALAR_BYTES)?;
        states.checked_add(of_rows)?.checked_add(of_positives)
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

    /// Bytes of a value in a column of states: all of a state, or what says of which frames it is made.
    pub(super) const fn value_bytes(&self) -> usize {
        match self.stacked {
            None => self.state_bytes,
            Some(stacked) => stacked.stack_bytes(),
        }
    }

    /// Frames that travel, and bytes of each: states where they are one frame.
    pub(super) const fn frames(&self) -> (usize, usize) {
        match self.stacked {
            None => (self.rows + self.states_k + self.states_n, self.state_bytes),
            Some(stacked) => (
                stacked.frames as usize,
                stacked.frame_bytes(self.state_bytes),
            ),
        }
    }

    /// Values that a row has in a column.
    pub(super) const fn values_a_row(&self, column: Column) -> usize {
        if column.is_per_positive() {
            self.positives
        } else {
            1
        }
    }

    pub(super) const fn column_bytes(&self, column: Column) -> usize {
        match column {
            Column::Frames => match self.stacked {
                None => 0,
                Some(_) => {
                    let (count, bytes) = self.frames();
                    count * bytes
                }
            },
            Column::StatesT => self.rows * self.value_bytes(),
            Column::StatesK => self.states_k * self.value_bytes(),
            Column::StatesN => self.states_n * self.value_bytes(),
            _ if column.is_of_priorities() && !self.is_prioritised => 0,
            _ => self.rows * self.values_a_row(column) * column.scalar_bytes(),
        }
    }

    pub(super) fn range(&self, column: Column) -> Range<usize> {
        let before = Column::ALL[..column as usize].iter();
        let start = before.map(|&column| self.column_bytes(column)).sum();
        start..start + self.column_bytes(column)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
            let layout = BatchLayout {
                rows,
                positives,
                state_bytes,
                states_k,
                states_n,
                is_prioritised: rows % 2 == 0,
                stacked: state_bytes.is_multiple_of(4).then_some(FRAMES),
            };
            let mut end = 0;
            for column in Column::ALL {
                let range = layout.range(column);
                assert_eq!(range.start, end, "{column:?}");
                end = range.end;
            }
            assert_eq!(layout.bytes(), Some(end));
        }
        let small = BatchLayout {
            rows: 2,
            positives: 2,
            state_bytes: 1,
            states_k: 4,
            states_n: 2,
            is_prioritised: false,
            stacked: None,
        };
        assert_eq!(small.bytes(), Some(2 * (3 + 1 + 10 + 2 * 2)));
        let prioritised = BatchLayout {
            is_prioritised: true,
            ..small
        };
        assert_eq!(prioritised.bytes(), Some(2 * (3 + 1 + 10 + 2 * 2 + 12)));
        let stacks = BatchLayout {
            state_bytes: 8,
            stacked: Some(FRAMES),
            ..small
        };
        // Five frames of two bytes, and four numbers of four for each of eight states.
        let of_states = 5 * 2 + 8 * 16;
        assert_eq!(stacks.bytes(), Some(of_states + 2 * (10 + 2 * 2)));
        let frames: [fn(&mut StackedFrames); 7] = [
            |it| it.frames = 8 * 4 + 1,
            |it| it.frame_stack = 0,
            |it| it.frame_stack = 1,
            |it| it.frame_stack = 3,
            |it| it.frame_stack = u32::MAX,
            |it| it.frame_channels = 0,
            |it| it.frame_channels = 3,
        ];
        for change in frames {
            let mut wrong = stacks;
            wrong.stacked.as_mut().map(change);
            assert_eq!(wrong.bytes(), None, "{wrong:?}");
        }
        type Change = fn(&mut BatchLayout);
        let layouts: [(BatchLayout, Change); 5] = [
            (stacks, |it| it.state_bytes = usize::MAX / 4 * 4),
            (small, |it| it.rows = usize::MAX),
            (small, |it| it.states_k = 5),
            (small, |it| it.states_n = 3),
            (small, |it| it.state_bytes = usize::MAX / 4),
        ];
        for (mut wrong, change) in layouts {
            change(&mut wrong);
            assert_eq!(wrong.bytes(), None, "{wrong:?}");
        }
    }
}
