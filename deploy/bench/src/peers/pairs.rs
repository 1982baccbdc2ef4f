//! Which figure of ours is compared with which of theirs, and the ratio that is wanted.
//! It measures nothing; names are those of the benches and of the scripts in `deploy/bench/peers/`.

use driml_learner::Precision;

use crate::flags::Component;

/// A figure of ours and the figure of a peer that it is compared with.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pair {
    /// The component whose bench has our figure.
    pub(super) component: Component,
    /// The name of our figure.
    pub(super) ours: &'static str,
    /// What it is compared with.
    pub(super) theirs: Theirs,
    /// The least ratio of ours to theirs that is wanted; none where it is only of interest.
    pub(super) goal: Option<f64>,
}

impl Pair {
    /// Whether our figure is of one of these precisions; figures of components that multiply nothing always are.
    pub(super) fn is_asked(&self, precisions: &[Precision]) -> bool {
        let bf16 = self.ours.ends_with(", bf16");
        let own = if bf16 {
            Precision::Bf16
        } else {
            Precision::F32
        };
        precisions.contains(&own) || !matches!(self.component, Learner | Policy)
    }
}

/// What a figure is compared with.
#[derive(Clone, Copy, Debug)]
pub(super) enum Theirs {
    /// A figure of the component's peer.
    Peers(&'static str),
    /// Another figure of the same bench of ours, and whom it stands for.
    Ours(&'static str, &'static str),
}

/// A figure that both sides have under one name.
const fn same(component: Component, name: &'static str, goal: Option<f64>) -> Pair {
    Pair {
        component,
        ours: name,
        theirs: Theirs::Peers(name),
        goal,
    }
}

/// A figure of the replay server's against one of Reverb's.
const fn replay(ours: &'static str, theirs: &'static str, goal: Option<f64>) -> Pair {
    Pair {
        component: Component::Replay,
        ours,
        theirs: Theirs::Peers(theirs),
        goal,
    }
}

use Component::{Env, Learner, Policy, Replay};

/// All comparisons, in the order of the table.
pub(super) const PAIRS: &[Pair] = &[
    same(Learner, "C51, 64x64x3", None),
    same(Learner, "C51 + global-global DIM, 64x64x3", Some(1.3)),
    // Beside the faster of PyTorch's f32 and bf16 autocast; the goal is that for AVX512_BF16, with AMX it is 3.
    same(Learner, "C51, 64x64x3, bf16", None),
    same(Learner, "C51 + global-global DIM, 64x64x3, bf16", Some(1.6)),
    same(
        Learner,
        "C51 + local-local + global-global DIM, 64x64x3, bf16",
        None,
    ),
    same(Learner, "C51 + global-global DIM, 104x80x3, bf16", None),
    Pair {
        component: Learner,
        ours: "C51 + global-global DIM, 64x64x3",
        theirs: Theirs::Ours(
            "C51 + global-global DIM, 64x64x3, candle's stock operations",
            "candle's stock operations",
        ),
        goal: Some(10.0),
    },
    same(
        Learner,
        "C51 + local-local + global-global DIM, 64x64x3",
        Some(1.2),
    ),
    same(Learner, "C51 + global-global DIM, 104x80x3", Some(1.2)),
    same(Policy, "32 frames of 64x64x3", Some(1.3)),
    same(Policy, "256 frames of 64x64x3", Some(1.3)),
    same(Policy, "32 frames of 64x64x3, bf16", None),
    same(Policy, "256 frames of 64x64x3, bf16", None),
    same(Policy, "32 frames of 104x80x3, bf16", None),
    same(Policy, "256 frames of 104x80x3, bf16", None),
    same(Policy, "32 frames of 104x80x3", Some(1.3)),
    same(Policy, "256 frames of 104x80x3", Some(1.3)),
    // Chunks of 256 transitions are what an actor sends.
    replay(
        "insert, 4 transitions a chunk, shared memory",
        "insert",
        None,
    ),
    replay(
        "insert, 32 transitions a chunk, shared memory",
        "insert",
        None,
    ),
    replay(
        "insert, 128 transitions a chunk, shared memory",
        "insert",
        None,
    ),
    replay(
        "insert, 256 transitions a chunk, shared memory",
        "insert",
        Some(40.0),
    ),
    replay("insert, 4 transitions a chunk, unix socket", "insert", None),
    replay(
        "insert, 32 transitions a chunk, unix socket",
        "insert",
        None,
    ),
    replay(
        "insert, 128 transitions a chunk, unix socket",
        "insert",
        None,
    ),
    replay(
        "insert, 256 transitions a chunk, unix socket",
        "insert",
        Some(12.0),
    ),
    replay("insert, 256 transitions a chunk, tcp", "insert", Some(12.0)),
    replay(
        "batch of 3 states, shared memory",
        "batch of 3 states",
        Some(10.0),
    ),
    replay(
        "batch of 3 states, unix socket",
        "batch of 3 states",
        Some(1.5),
    ),
    replay("batch of 3 states, tcp", "batch of 3 states", Some(1.5)),
    // With k chosen by the client, as only a sequence allows it there.
    replay(
        "batch of 3 states, shared memory",
        "batch of sequences of 8 states",
        None,
    ),
    replay(
        "batch of 3 states, unix socket",
        "batch of sequences of 8 states",
        None,
    ),
    Pair {
        component: Replay,
        ours: "batch of 3 states, without a wire",
        theirs: Theirs::Ours(
            "plain copy of a batch's bytes",
            "a plain copy of the same bytes",
        ),
        goal: Some(1.0 / 1.5),
    },
    same(Env, "bigfish, 32 copies, 0 engine threads", Some(1.0)),
    same(Env, "bigfish, 32 copies, 2 engine threads", Some(1.0)),
    same(Env, "coinrun, 32 copies, 0 engine threads", Some(1.0)),
    same(Env, "coinrun, 32 copies, 2 engine threads", Some(1.0)),
    same(Env, "maze, 32 copies, 0 engine threads", Some(1.0)),
    same(Env, "maze, 32 copies, 2 engine threads", Some(1.0)),
    same(Env, "starpilot, 32 copies, 0 engine threads", Some(1.0)),
    same(Env, "starpilot, 32 copies, 2 engine threads", Some(1.0)),
];
