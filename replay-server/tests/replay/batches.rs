//! Compares batches with the reference, through wrap-around, restarts, losses, retries and stray chunks.
//! It does not test how often each row or k comes: `rows` and `horizon` do.

use std::collections::{HashMap, HashSet};

use driml_protocol::{
    Batch, BatchHeader, Chunk, ChunkHeader, Horizon, InsertReply, RunSpec, TimeoutRule, Waiting,
};
use driml_replay_server::{Compression, Config, NotReady, PackedBatch, Replay};
use proptest::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    calls::{Actor, is_refused, join, prioritised, stored},
    history::{History, identity, spec},
};

/// Checks every row of `batch`, and the batch's header, against the reference.
pub(crate) fn check_batch(batch: &Batch, history: &History) {
    let (mean_age, versions) = check_rows(batch, history);
    assert_eq!(batch.header.mean_age, mean_age);
    assert_eq!(batch.header.weights_versions, versions);
    assert_eq!(batch.header.counts.inserted, history.inserted);
    assert_eq!(batch.header.held, history.inserted - history.oldest());
}

/// Checks every row of `batch` against the reference. Returns the mean age, and the newest and oldest versions of the weights that acted.
pub(crate) fn check_rows(batch: &Batch, history: &History) -> (f64, (u64, u64)) {
    let spec = &history.spec;
    let (rows, bytes) = (batch.rows(), spec.state_bytes());
    let state = |plane: &[u8], row: usize| plane[row * bytes..(row + 1) * bytes].to_vec();
    let (returns, discounts) = (batch.n_step_returns(), batch.bootstrap_discounts());
    let (mut ages, mut versions) = (0, (0, u64::MAX));
    let [states_t, states_k, states_n] = [batch.states_t(), batch.states_k(), batch.states_n()];
    check_frames(batch, spec);
    let mut next = states_n.chunks_exact(bytes);
    for row in 0..rows {
        let (key, t) = identity(spec, &state(&states_t, row));
        assert!(
            history.is_valid(key, t),
            "{key:?} step {t} is not a valid anchor"
        );
        let want = history.row(key, t);
        let context = format!("{key:?} step {t}: {want:?}");
        let record = &history.streams[&key][t];
        assert_eq!(state(&states_t, row), history.state(key, t), "{context}");
        assert_eq!(batch.actions()[row], want.action, "{context}");
        assert_eq!(batch.next_actions()[row], want.next_action, "{context}");
        let (sum, discount) = (f64::from(returns[row]), f64::from(discounts[row]));
        assert!((sum - want.n_step_return).abs() < 1e-5, "{context}: {sum}");
        assert!(
            (discount - want.discount).abs() < 1e-6,
            "{context}: {discount}"
        );
        // A bootstrap state with discount 0 is not sent.
        if let Some(i) = want.bootstrap.filter(|_| discounts[row] != 0.0) {
            let frame_n = next.next().expect("a row that bootstraps has its state");
            assert_eq!(frame_n, history.state(key, t + i), "{context}");
        }
        assert_eq!(batch.positives(), spec.horizon.positives());
        for p in 0..batch.positives() {
            // Positives are [P, B].
            let at = p * rows + row;
            let k = usize::from(batch.ks()[at]);
            let right = match (spec.horizon, want.steps_left) {
                (_, 0) => k == 0,
                (Horizon::Fixed { .. }, left) => k == left,
                (Horizon::All { .. }, left) => k == if p < left { p + 1 } else { 0 },
                (_, left) => (1..=left).contains(&k),
            };
            assert!(right, "{context}: k = {k}");
            assert_eq!(batch.positive_valid()[at], u8::from(k > 0), "{context}");
            if k > 0 {
                let place = batch.positive_valid()[..at].iter().filter(|it| **it != 0);
                let frame_k = state(&states_k, place.count());
                assert_eq!(frame_k, history.state(key, t + k), "{context}: k = {k}");
            }
        }
        ages += history.inserted - 1 - record.index;
        versions = (
            record.weights_version.max(versions.0),
            record.weights_version.min(versions.1),
        );
    }
    assert!(next.next().is_none(), "no state that no row has");
    let positives = batch.positive_valid().iter().filter(|it| **it != 0);
    assert_eq!(states_k.len(), positives.count() * bytes);
    (ages as f64 / rows as f64, versions)
}

/// Checks that each frame of stacked states is sent once, and that the payload is at most as long as `BatchHeader::largest` computes.
fn check_frames(batch: &Batch, spec: &RunSpec) {
    let (header, payload) = batch.clone().into_payload();
    assert_eq!(&Batch::from_payload(header, payload).unwrap(), batch);
    let reckoned = BatchHeader {
        origin: header.origin,
        ..BatchHeader::largest(spec, header.rows)
    };
    assert_eq!(header.stacked.is_some(), spec.frame_stack > 1);
    assert!(header.payload_bytes() <= reckoned.payload_bytes());
    let Some(stacked) = header.stacked else {
        return;
    };
    let planes = [batch.states_t(), batch.states_k(), batch.states_n()];
    let (channels, stack) = (spec.frame_channels as usize, spec.frame_stack as usize);
    let mut frames = HashSet::new();
    for state in planes
        .iter()
        .flat_map(|plane| plane.chunks(spec.state_bytes()))
    {
        let pixels = state.chunks(channels * stack);
        let frame = |slot: usize| {
            pixels
                .clone()
                .flat_map(move |it| &it[slot * channels..][..channels])
        };
        frames.extend((0..stack).map(|slot| frame(slot).copied().collect::<Vec<u8>>()));
    }
    let sent = stacked.frames as usize;
    assert_eq!(sent, frames.len(), "each frame is another");
}

fn horizons() -> impl Strategy<Value = Horizon> {
    prop_oneof![
        Just(Horizon::None {}),
        (1u32..7).prop_map(|k| Horizon::Fixed { k }),
        (1u32..7).prop_map(|k_max| Horizon::Uniform { k_max }),
        (1u32..7).prop_map(|k_max| Horizon::Nhg { k_max }),
        (1u32..7).prop_map(|k_max| Horizon::All { k_max }),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, ..ProptestConfig::default() })]

    #[test]
    fn every_row_equals_the_reference(
        seed in any::<u64>(),
        stack in prop_oneof![Just(1u32), Just(4), 2u32..4],
        channels in 1u32..6,
        n_step in 1u32..8,
        horizon in horizons(),
        (bootstrap, lz4, is_prioritised) in any::<(bool, bool, bool)>(),
        capacity in 24u64..160,
        (actors, streams) in (1u32..4, 1u32..4),
    ) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut spec = spec(channels, stack, n_step, horizon);
        if bootstrap {
            spec.timeout = TimeoutRule::Bootstrap;
        }
        let mut config = match is_prioritised {
            true => prioritised(capacity, 0.5),
            false => Config::unlimited(capacity),
        };
        if lz4 {
            config.compression = Compression::Lz4;
        }
        let mut replay = Replay::new(&spec, &config, 8).unwrap();
        let mut history = History::new(&spec, capacity);
        // Each actor, with the part of its incarnation; a part ends where transitions are lost.
        let mut known: HashMap<u32, (Actor, u8)> = HashMap::new();
        let (mut lost, mut retried, mut refused, mut rows_sampled) = (0, 0, 0, 0);
        for _ in 0..150 {
            let number = rng.random_range(0..actors);
            let fresh = |incarnation| {
                let mut actor = Actor::new(number, incarnation);
                actor.next.frame_bytes = spec.frame_bytes() as u32;
                actor.next.weights_version = 1 << 40;
                (actor, 0)
            };
            let (actor, part) = known.entry(number).or_insert_with(|| fresh(1));
            join(&mut replay, number, actor.next.incarnation);
            match rng.random_range(0..20) {
                // The actor dies and restarts. A late chunk of its former incarnation is rejected.
                0 => {
                    let old = actor.next;
                    (*actor, *part) = fresh(old.incarnation + 1);
                    join(&mut replay, number, actor.next.incarnation);
                    let chunk = history.next_chunk(actor.send(streams, 1), 0, &mut rng);
                    prop_assert_eq!(replay.insert(&chunk), stored(history.inserted));
                    if old.sequence > 0 {
                        let answer = replay.insert(&Chunk::zeroed(old));
                        prop_assert!(is_refused(&answer), "{:?}", answer);
                        refused += 1;
                    }
                }
                // Transitions are lost before the next chunk.
                1 if actor.next.sequence > 0 && *part < 200 => {
                    let count = rng.random_range(1..9);
                    actor.next.first_transition += count;
                    *part += 1;
                    lost += count;
                    let chunk = history.next_chunk(actor.send(streams, 1), *part, &mut rng);
                    prop_assert_eq!(replay.insert(&chunk), stored(history.inserted));
                }
                // A retry of a stored chunk.
                2 if actor.next.sequence > 0 => {
                    let sequence = rng.random_range(0..actor.next.sequence);
                    let chunk = Chunk::zeroed(ChunkHeader { sequence, ..actor.next });
                    prop_assert_eq!(replay.insert(&chunk), stored(history.inserted));
                    retried += 1;
                }
                // A chunk that is out of order.
                3 => {
                    let sequence = actor.next.sequence + rng.random_range(1..4);
                    let chunk = Chunk::zeroed(ChunkHeader { sequence, ..actor.next });
                    let expected = InsertReply::OutOfOrder { expected: actor.next.sequence };
                    prop_assert_eq!(replay.insert(&chunk), expected);
                }
                4..12 => {
                    actor.next.weights_version += rng.random_range(0..2);
                    let header = actor.send(streams, rng.random_range(1..6));
                    let chunk = history.next_chunk(header, *part, &mut rng);
                    prop_assert_eq!(replay.insert(&chunk), stored(history.inserted));
                }
                _ if history.inserted == 0 => {}
                // The memory is not zeroed, so that a byte that is not written shows.
                _ => match replay.draw(8, |bytes| vec![0xAB; bytes].into()).map(PackedBatch::unpack) {
                    Ok(batch) => {
                        check_batch(&batch, &history);
                        rows_sampled += 8;
                        let found = rng.random::<[f32; 8]>().map(|it| 100.0 * it);
                        if let Some(update) = batch.priority_update(1, rows_sampled, &found) {
                            replay.set_priorities(&update).unwrap();
                        }
                    }
                    Err(not_ready) => {
                        prop_assert_eq!(not_ready, NotReady::Wait(Waiting::LearnerWaitsForActors));
                        prop_assert!(history.valid_anchors().is_empty());
                    }
                },
            }
            replay.check_valid();
        }
        for (actor, _) in known.values().filter(|(it, _)| it.next.sequence > 0) {
            replay.leave(&actor.leave());
        }
        let status = replay.status();
        let (episodes, mean_return) = history.episodes();
        prop_assert_eq!(status.transitions_inserted, history.inserted);
        // After a draw that found no anchor, none count as held.
        let is_starving = status.transitions_held == 0 && history.valid_anchors().is_empty();
        prop_assert!(is_starving || status.transitions_held == history.inserted.min(capacity));
        prop_assert_eq!((status.transitions_lost, status.transitions_duplicated), (lost, 0));
        prop_assert_eq!((status.chunks_retried, status.messages_refused), (retried, refused));
        prop_assert_eq!((status.episodes, status.rows_sampled), (episodes, rows_sampled));
        let found = status.returns.mean();
        let same = match (found, mean_return) {
            (Some(have), Some(want)) => (have - want).abs() < 1e-9,
            (have, want) => have == want,
        };
        prop_assert!(same, "{found:?} is not {mean_return:?}");
    }
}
