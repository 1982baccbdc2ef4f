//! The list of comparisons: a figure of ours, a figure of theirs, and the ratio that is wanted.
//! This file measures nothing. The names are those of the benches and of the scripts in `deploy/bench/peers/`.

use crate::{
    env,
    flags::Component::{self, Env, Learner, Policy, Replay},
    in_process,
    learner::{CANDLE_SUFFIX, GLOBAL_DIM_CASE},
    recording::CHUNKS,
    replay::insert_name,
};

#[derive(Clone, Debug)]
pub(super) struct Pair {
    pub(super) component: Component,
    pub(super) ours: String,
    pub(super) theirs: String,
    /// `None` if `theirs` is a figure of the peer. Else it is another figure of ours, and this describes it.
    pub(super) own_figure: Option<&'static str>,
    /// The lowest ratio of ours to theirs that is wanted; `None` without a goal.
    pub(super) goal: Option<f64>,
}

pub(super) fn pairs() -> Vec<Pair> {
    let mut pairs = Vec::new();
    let mut add = |component, ours: &str, theirs: &str, goal| {
        pairs.push(Pair {
            component,
            ours: ours.to_owned(),
            theirs: theirs.to_owned(),
            own_figure: match theirs {
                in_process::PLAIN_COPY => Some("a plain copy of the same bytes"),
                _ if theirs.ends_with(CANDLE_SUFFIX) => Some(CANDLE_SUFFIX),
                _ => None,
            },
            goal,
        });
    };
    // The peer in bf16 is the faster of PyTorch's f32 and bf16 autocast. The goals in bf16 are for AVX512_BF16; with AMX the goal is 3.
    for (case, f32, bf16) in [
        ("C51", None, None),
        ("C51 + global-global DIM", Some(1.3), Some(1.6)),
        ("C51 + local-local + global-global DIM", Some(1.2), None),
        ("C51 + global-global DIM, 104x80x3", Some(1.2), None),
        ("C51, impala", Some(1.5), Some(1.8)),
        ("C51, impala, 64x64x3, 64 rows", Some(1.5), Some(1.8)),
        ("C51, impala, half width", Some(1.5), Some(1.8)),
        ("C51 + global-global DIM, impala", Some(1.5), Some(1.8)),
    ] {
        let size = if case.contains("x3") { "" } else { ", 64x64x3" };
        let name = format!("{case}{size}");
        add(Learner, &name, &name, f32);
        let name = format!("{name}, bf16");
        add(Learner, &name, &name, bf16);
    }
    let candle = format!("{GLOBAL_DIM_CASE}, {CANDLE_SUFFIX}");
    add(Learner, GLOBAL_DIM_CASE, &candle, None);
    for (network, f32, bf16) in [
        ("64x64x3", 1.3, None),
        ("104x80x3", 1.3, None),
        ("64x64x3, impala", 1.5, Some(1.8)),
        ("64x64x3, impala, half width", 1.5, Some(1.8)),
    ] {
        for frames in [32, 256] {
            let name = format!("{frames} frames of {network}");
            add(Policy, &name, &name, Some(f32));
            let name = format!("{name}, bf16");
            add(Policy, &name, &name, bf16);
        }
    }
    for (wire, insert, batch) in [
        ("shared memory", 40.0, 10.0),
        ("unix socket", 12.0, 1.5),
        ("tcp", 12.0, 1.5),
    ] {
        for chunk in CHUNKS {
            // Only the chunk that an actor sends has a goal.
            let goal = (chunk.transitions() == 256).then_some(insert);
            let name = insert_name(chunk.transitions(), wire);
            add(Replay, &name, "insert", goal);
        }
        let name = format!("batch of 3 states, {wire}");
        add(Replay, &name, "batch of 3 states", Some(batch));
        // In Reverb the client can choose k only within a sequence.
        let sequences = "batch of sequences of 8 states";
        add(Replay, &name, sequences, None);
    }
    let copied = in_process::PLAIN_COPY;
    add(Replay, in_process::ASSEMBLY, copied, Some(1.0 / 1.5));
    for game in env::GAMES {
        for threads in env::ENGINE_THREADS {
            let name = env::label(game, threads);
            add(Env, &name, &name, Some(1.0));
        }
    }
    pairs
}
