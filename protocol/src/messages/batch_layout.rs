//! How the columns of a batch lie in its payload: which there are, how wide they are, and where each begins.
//! What the values mean is said at `Batch`.

use std::ops::Range;

/// The columns of a batch, in the order in which they lie one after the other. Each has a value for every row; those of the
/// positives have one for every row of the first positive, then of the second, and so on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Column {
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
}

impl Column {
    /// All of them, in their order.
    pub(super) const ALL: [Self; 9] = [
        Self::StatesT,
        Self::StatesK,
        Self::StatesN,
        Self::NStepReturn,
        Self::BootstrapDiscount,
        Self::Action,
        Self::NextAction,
        Self::PositiveValid,
        Self::K,
    ];

    /// Whether it has a value for each positive of a row.
    const fn is_per_positive(self) -> bool {
        matches!(self, Self::StatesK | Self::PositiveValid | Self::K)
    }

    /// Whether its values are states, whose size is the run's.
    const fn holds_states(self) -> bool {
        matches!(self, Self::StatesT | Self::StatesK | Self::StatesN)
    }

    /// Bytes of a value that is no state.
    const fn scalar_bytes(self) -> usize {
        match self {
            Self::StatesT | Self::StatesK | Self::StatesN => 0,
            Self::NStepReturn | Self::BootstrapDiscount => size_of::<f32>(),
            Self::Action | Self::NextAction | Self::PositiveValid | Self::K => size_of::<u8>(),
        }
    }
}

/// What the columns of one kind take together.
struct Widths {
    states: usize,
    scalar_bytes: usize,
}

/// States and bytes of scalars, of a row itself or of one of its positives.
const fn widths(per_positive: bool) -> Widths {
    let (mut states, mut scalar_bytes, mut at) = (0, 0, 0);
    while at < Column::ALL.len() {
        let column = Column::ALL[at];
        assert!(
            column as usize == at,
            "the order of ALL is that of the columns"
        );
        if column.is_per_positive() == per_positive {
            states += column.holds_states() as usize;
            scalar_bytes += column.scalar_bytes();
        }
        at += 1;
    }
    Widths {
        states,
        scalar_bytes,
    }
}

const ROW: Widths = widths(false);
const POSITIVE: Widths = widths(true);
const _: () = assert!(ROW.states == 2 && ROW.scalar_bytes == 10);
const _: () = assert!(POSITIVE.states == 1 && POSITIVE.scalar_bytes == 2);

/// The shape of a batch, from which the place of every value follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct BatchLayout {
    /// Rows, B.
    pub(super) rows: usize,
    /// Positives a row, P.
    pub(super) positives: usize,
    /// Bytes of one state.
    pub(super) state_bytes: usize,
}

impl BatchLayout {
    /// Bytes of all columns; none if they are more than the address space.
    pub(super) fn bytes(&self) -> Option<usize> {
        let row = self.width(&ROW)?;
        let positives = self.width(&POSITIVE)?.checked_mul(self.positives)?;
        self.rows.checked_mul(row.checked_add(positives)?)
    }

    fn width(&self, of: &Widths) -> Option<usize> {
        let states = of.states.checked_mul(self.state_bytes)?;
        states.checked_add(of.scalar_bytes)
    }

    /// Values that a row has in a column.
    pub(super) const fn values_a_row(&self, column: Column) -> usize {
        if column.is_per_positive() {
            self.positives
        } else {
            1
        }
    }

    /// Bytes of one value of a column.
    pub(super) const fn value_bytes(&self, column: Column) -> usize {
        if column.holds_states() {
            self.state_bytes
        } else {
            column.scalar_bytes()
        }
    }

    /// Bytes of a column.
    pub(super) const fn column_bytes(&self, column: Column) -> usize {
        self.rows * self.values_a_row(column) * self.value_bytes(column)
    }

    /// Where a column lies in the payload.
    pub(super) fn range(&self, column: Column) -> Range<usize> {
        let before = Column::ALL[..column as usize].iter();
        let start = before.map(|&column| self.column_bytes(column)).sum();
        start..start + self.column_bytes(column)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_fill_the_payload_without_gaps() {
        for (rows, positives, state_bytes) in [(1, 0, 1), (3, 1, 4), (256, 5, 12_288)] {
            let layout = BatchLayout {
                rows,
                positives,
                state_bytes,
            };
            let mut end = 0;
            for column in Column::ALL {
                let range = layout.range(column);
                assert_eq!(range.start, end, "{column:?}");
                end = range.end;
            }
            assert_eq!(layout.bytes(), Some(end));
        }
        let huge = BatchLayout {
            rows: usize::MAX,
            positives: 2,
            state_bytes: 1,
        };
        assert_eq!(huge.bytes(), None);
    }
}
