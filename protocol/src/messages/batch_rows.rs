//! How a batch is written: first all of its rows but their states, then each state, or its frames, in the place that follows from them.
//! `Batch` documents what the values mean.

use std::ops::Range;

use super::{batch_frames::StackedFrames, batch_header::BatchHeader, batch_layout::Column};

/// All of a row but its states.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowScalars {
    /// a_t.
    pub action: u8,
    /// a_{t+1}, or [`NO_ACTION`](crate::NO_ACTION).
    pub next_action: u8,
    /// Sum of gamma^i r_{t+i} over i < n, stopped at the episode's end.
    pub n_step_return: f32,
    /// gamma^n, or 0 where the row does not bootstrap.
    pub bootstrap_discount: f32,
    /// Positives that the row has: the first so many of P.
    pub positives: u32,
    /// k of the first of them; the others follow it step by step. It travels capped at 255.
    pub k_first: u32,
}

impl RowScalars {
    /// Whether the row has an s_{t+n}.
    pub fn bootstraps(&self) -> bool {
        self.bootstrap_discount != 0.0
    }

    /// k of each positive that the row has.
    pub const fn ks(&self) -> Range<u32> {
        self.k_first..self.k_first + self.positives
    }

    pub(super) fn write(&self, header: &BatchHeader, payload: &mut [u8], row: usize) {
        assert!(self.positives <= header.positives, "at most P");
        let mut put = |column, at: usize, bytes: &[u8]| {
            let column = &mut payload[header.range(column)];
            column[at * bytes.len()..][..bytes.len()].copy_from_slice(bytes);
        };
        put(Column::NStepReturn, row, &self.n_step_return.to_le_bytes());
        let discount = self.bootstrap_discount.to_le_bytes();
        put(Column::BootstrapDiscount, row, &discount);
        put(Column::Action, row, &[self.action]);
        put(Column::NextAction, row, &[self.next_action]);
        for p in 0..header.positives {
            let there = p < self.positives;
            let k = u8::try_from(self.k_first + p).unwrap_or(u8::MAX);
            let at = p as usize * header.rows as usize + row;
            put(Column::PositiveValid, at, &[there.into()]);
            put(Column::K, at, &[if there { k } else { 0 }]);
        }
    }
}

/// The places of a batch's states and their frames, borrowed for writing.
///
/// States have numbers: those of s_t, then those of s_{t+k}, then those of s_{t+n}. Where a state is one frame, that has its number.
#[derive(Debug)]
pub struct BatchStatesMut<'a> {
    rows: usize,
    frame_bytes: usize,
    /// The frames that travel.
    frames: &'a mut [u8],
    /// Of each state, which of them it is made of; none where states are one frame each.
    stacks: &'a mut [u8],
    stack_bytes: usize,
    /// Of each positive [P, B] the number of its state.
    numbers_k: Vec<Option<usize>>,
    /// Of each row the number of its s_{t+n}.
    numbers_n: Vec<Option<usize>>,
}

impl<'a> BatchStatesMut<'a> {
    /// Those of a payload whose scalars are written.
    pub(super) fn new(header: BatchHeader, payload: &'a mut [u8]) -> Self {
        let rows = header.rows as usize;
        let first_n = rows + header.states_k as usize;
        let numbers_k = numbers(&header.positives_there(payload), rows);
        let numbers_n = numbers(&header.bootstraps(payload), first_n);
        let (count, frame_bytes) = header.frames();
        let (frames, rest) = payload.split_at_mut(count * frame_bytes);
        let (stack_bytes, stacks) = match header.stacked {
            None => (0, &mut [][..]),
            Some(_) => {
                let bytes = header.value_bytes();
                let states = first_n + header.states_n as usize;
                (bytes, &mut rest[..states * bytes])
            }
        };
        Self {
            rows,
            frame_bytes,
            frames,
            stacks,
            stack_bytes,
            numbers_k,
            numbers_n,
        }
    }

    /// The numbers of the states that `row` has, in this order: of s_t, of s_{t+n}, and of s_{t+k} of each positive.
    pub fn of_row(&self, row: usize) -> impl Iterator<Item = usize> {
        let of_positives = self.numbers_k.iter().skip(row).step_by(self.rows);
        let first = [Some(row), self.numbers_n[row]];
        first.into_iter().chain(of_positives.copied()).flatten()
    }

    /// Where frame `number` is written.
    pub fn frame(&mut self, number: usize) -> &mut [u8] {
        &mut self.frames[number * self.frame_bytes..][..self.frame_bytes]
    }

    /// Says of which frames state `number` is made, oldest first.
    pub fn set_stack(&mut self, number: usize, frames: &[u32]) {
        let stack = &mut self.stacks[number * self.stack_bytes..][..self.stack_bytes];
        StackedFrames::write(stack, frames);
    }
}

/// Of each its number, counted from `first` over those that are there.
fn numbers(there: &[bool], first: usize) -> Vec<Option<usize>> {
    let mut next = first;
    let number = |&there: &bool| {
        there.then(|| {
            next += 1;
            next - 1
        })
    };
    there.iter().map(number).collect()
}
