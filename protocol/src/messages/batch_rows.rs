//! How a batch is written: first all of its rows but their states, then each state in the place that follows from them.
//! What the values mean is said at `Batch`.

use super::batch_layout::{BatchLayout, Column};

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

    /// Writes them as those of `row`.
    pub(super) fn write(&self, layout: &BatchLayout, payload: &mut [u8], row: usize) {
        assert!(self.positives as usize <= layout.positives, "at most P");
        let mut put = |column, at: usize, bytes: &[u8]| {
            let column = &mut payload[layout.range(column)];
            column[at * bytes.len()..][..bytes.len()].copy_from_slice(bytes);
        };
        put(Column::NStepReturn, row, &self.n_step_return.to_le_bytes());
        let discount = self.bootstrap_discount.to_le_bytes();
        put(Column::BootstrapDiscount, row, &discount);
        put(Column::Action, row, &[self.action]);
        put(Column::NextAction, row, &[self.next_action]);
        for p in 0..layout.positives {
            let there = p < self.positives as usize;
            let k = u8::try_from(self.k_first + p as u32).unwrap_or(u8::MAX);
            let at = p * layout.rows + row;
            put(Column::PositiveValid, at, &[there.into()]);
            put(Column::K, at, &[if there { k } else { 0 }]);
        }
    }
}

/// The places of a batch's states, borrowed for writing.
#[derive(Debug)]
pub struct BatchStatesMut<'a> {
    rows: usize,
    state_bytes: usize,
    states_t: &'a mut [u8],
    states_k: &'a mut [u8],
    states_n: &'a mut [u8],
    /// Of each positive [P, B] its place among those that travel.
    places_k: Vec<Option<usize>>,
    /// Of each row the place of its s_{t+n} among those that travel.
    places_n: Vec<Option<usize>>,
}

impl<'a> BatchStatesMut<'a> {
    /// Those of a payload whose scalars are written.
    pub(super) fn new(layout: BatchLayout, payload: &'a mut [u8]) -> Self {
        let places_k = places(&layout.positives_there(payload));
        let places_n = places(&layout.bootstraps(payload));
        let (states_t, rest) = payload.split_at_mut(layout.column_bytes(Column::StatesT));
        let (states_k, rest) = rest.split_at_mut(layout.column_bytes(Column::StatesK));
        Self {
            rows: layout.rows,
            state_bytes: layout.state_bytes,
            states_t,
            states_k,
            states_n: &mut rest[..layout.column_bytes(Column::StatesN)],
            places_k,
            places_n,
        }
    }

    /// Where s_t of `row` is written.
    pub fn t(&mut self, row: usize) -> &mut [u8] {
        &mut self.states_t[row * self.state_bytes..][..self.state_bytes]
    }

    /// Where s_{t+k} of positive `p` of `row` is written, if the row has it.
    pub fn k(&mut self, p: usize, row: usize) -> Option<&mut [u8]> {
        let place = self.places_k[p * self.rows + row]?;
        Some(&mut self.states_k[place * self.state_bytes..][..self.state_bytes])
    }

    /// Where s_{t+n} of `row` is written, if the row bootstraps.
    pub fn n(&mut self, row: usize) -> Option<&mut [u8]> {
        let place = self.places_n[row]?;
        Some(&mut self.states_n[place * self.state_bytes..][..self.state_bytes])
    }
}

/// Of each its place among those that are there.
fn places(there: &[bool]) -> Vec<Option<usize>> {
    let mut next = 0;
    let place = |&there: &bool| {
        there.then(|| {
            next += 1;
            next - 1
        })
    };
    there.iter().map(place).collect()
}
