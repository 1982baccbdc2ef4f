//! Which rows are drawn: the law of both rules, which transitions are drawn, and late, repeated or foreign priorities.
//! It does not check what the rows hold: `batches` does.

use std::collections::HashMap;

use driml_protocol::{Batch, Horizon, Origin, PriorityPart, PriorityUpdate};
use driml_replay_server::{Config, PRIORITY_MIN, PriorityCounts, Replay};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    batches::check_rows,
    calls::{Actor, join, prioritised},
    history::{History, StreamKey, identity, spec},
    law::ChiSquare,
    persist::args,
};

const ROWS: u32 = 64;
const LEARNER: u64 = 5;

/// A replay, all transitions that it ever stored, and their expected priorities.
struct Setup {
    replay: Replay,
    history: History,
    rng: ChaCha8Rng,
    /// `None` if rows are drawn uniformly.
    alpha: Option<f64>,
    /// The priority of each transition that was learned from.
    priorities: HashMap<u64, f64>,
    /// The priority of each transition when it became an anchor: the highest at that time.
    first: HashMap<u64, f64>,
    highest: f64,
    updates: u64,
    actors: [Actor; 4],
}

impl Setup {
    fn new(capacity: u64, alpha: Option<f64>, frame_stack: u32) -> Self {
        let spec = spec(3, frame_stack, 4, Horizon::Uniform { k_max: 6 });
        let config = alpha.map_or(Config::unlimited(capacity), |alpha| {
            prioritised(capacity, alpha)
        });
        let mut replay = Replay::new(&spec, &config, ROWS).unwrap();
        for actor in 0..4 {
            join(&mut replay, actor, 1);
        }
        Self {
            replay,
            history: History::new(&spec, capacity),
            rng: ChaCha8Rng::seed_from_u64(3),
            alpha,
            priorities: HashMap::new(),
            first: HashMap::new(),
            highest: 1.0,
            updates: 0,
            actors: [0, 1, 2, 3].map(|actor| Actor::new(actor, 1)),
        }
    }

    fn insert(&mut self, actor: u32, streams: u32, steps: u32) {
        let header = self.actors[actor as usize].send(streams, steps);
        let chunk = self.history.next_chunk(header, 0, &mut self.rng);
        self.replay.insert(&chunk);
        for index in self.anchors() {
            self.first.entry(index).or_insert(self.highest);
        }
        self.replay.check_valid();
    }

    /// Returns the index of every transition that can be drawn.
    fn anchors(&self) -> Vec<u64> {
        let anchors = self.history.valid_anchors().into_iter();
        let index = |(key, t): (StreamKey, usize)| self.history.streams[&key][t].index;
        anchors.map(index).collect()
    }

    fn indices(&self, batch: &Batch) -> Vec<u64> {
        let spec = &self.history.spec;
        let states_t = batch.states_t();
        let states = states_t.chunks(spec.state_bytes());
        let index = |state| {
            let (key, t) = identity(spec, state);
            self.history.streams[&key][t].index
        };
        states.map(index).collect()
    }

    /// Draws a batch and, with priorities, sends random losses for its rows.
    fn learn(&mut self) -> Option<PriorityUpdate> {
        let batch = self.replay.sample(ROWS).unwrap();
        check_rows(&batch, &self.history);
        self.alpha?;
        let found: Vec<f32> = (0..ROWS)
            .map(|_| self.rng.random_range(0.0f32..4.0).powi(3))
            .collect();
        self.updates += 1;
        let update = batch.priority_update(LEARNER, self.updates, &found);
        let update = update.unwrap();
        assert_eq!(update.parts[0].transitions, self.indices(&batch));
        for (index, found) in update.parts[0].transitions.iter().zip(&found) {
            self.priorities.insert(*index, f64::from(*found));
            self.highest = self.highest.max(f64::from(*found));
        }
        self.replay.set_priorities(&update).unwrap();
        Some(update)
    }

    /// Computes the law over the anchors with a plain loop: the paper's law, or the uniform one.
    fn law(&self) -> HashMap<u64, f64> {
        let mass = |index| {
            let priority = self.priorities.get(&index).or(self.first.get(&index));
            let alpha = self.alpha.unwrap_or(0.0);
            (priority.unwrap() + PRIORITY_MIN).powf(alpha)
        };
        let anchors = self.anchors().into_iter();
        let masses: Vec<_> = anchors.map(|index| (index, mass(index))).collect();
        let total: f64 = masses.iter().map(|it| it.1).sum();
        let law = masses
            .into_iter()
            .map(|(index, mass)| (index, mass / total));
        law.collect()
    }

    /// Checks that draws follow the law, and that batches report the right probabilities.
    fn check_law(&mut self, what: &str) {
        let what = format!("alpha {:?}: {what}", self.alpha);
        let law = self.law();
        let mut counts: HashMap<u64, u64> = law.keys().map(|&index| (index, 0)).collect();
        // Some stacks may have lost their first frames. Draws find each such anchor once; then the probabilities follow the law.
        for _ in 0..20 {
            self.replay.sample(ROWS).unwrap();
        }
        for _ in 0..law.len() * 4 {
            let batch = self.replay.sample(ROWS).unwrap();
            let indices = self.indices(&batch);
            for index in &indices {
                *counts.get_mut(index).unwrap() += 1;
            }
            let chances = batch.probabilities().into_iter().flatten();
            for (index, chance) in indices.into_iter().zip(chances) {
                let (chance, expected) = (f64::from(chance), law[&index]);
                assert!(chance <= expected * (1.0 + 1e-5), "{chance}, {expected}");
                let may_hide = self.history.spec.frame_stack > 1;
                let near = chance >= expected * (1.0 - 1e-5);
                assert!(near || may_hide, "{chance}, {expected}");
            }
        }
        let both = law.iter().map(|(index, chance)| (counts[index], *chance));
        let (counts, chances): (Vec<u64>, Vec<f64>) = both.unzip();
        let mut chi = ChiSquare::default();
        chi.add(&counts, &chances);
        chi.check(&what);
    }
}

#[test]
fn draws_follow_the_law_of_their_rule() {
    let cases = [
        (None, 1),
        (None, 4),
        (Some(0.0), 1),
        (Some(0.5), 1),
        (Some(0.5), 4),
        (Some(1.0), 1),
    ];
    for (alpha, frame_stack) in cases {
        let mut setup = Setup::new(200, alpha, frame_stack);
        for (rounds, what) in [(12, "a ring that is not full"), (20, "a full ring")] {
            for _ in 0..rounds {
                setup.insert(0, 2, 5);
                setup.insert(1, 1, 3);
                setup.learn();
            }
            setup.check_law(&format!("{what}, stack {frame_stack}"));
        }
        assert!(setup.history.oldest() > 0 && setup.anchors().len() > 100);
    }
}

/// Opens a replay on disk again with another alpha. An alpha of 0 stores no priorities, so all become the highest.
#[test]
fn priorities_that_were_kept_follow_the_law_of_another_alpha() {
    for (before, now) in [(0.5, 0.5), (0.5, 1.0), (1.0, 0.3), (0.4, 0.0), (0.0, 0.6)] {
        let mut setup = Setup::new(200, Some(before), 1);
        let (folder, spec) = (tempfile::tempdir().unwrap(), setup.history.spec.clone());
        let args = args(folder.path(), 1 << 20);
        let open = |alpha| Replay::open(&args, &spec, &prioritised(200, alpha), ROWS).unwrap();
        setup.replay = open(before).0;
        (0..4).for_each(|actor| join(&mut setup.replay, actor, 1));
        for _ in 0..20 {
            setup.insert(0, 2, 5);
            setup.insert(1, 1, 3);
            setup.learn();
        }
        setup.replay.mark().unwrap();
        drop(setup.replay);
        (setup.replay, setup.alpha) = (open(now).0, Some(now));
        if before == 0.0 {
            setup.priorities.clear();
            setup.first.values_mut().for_each(|it| *it = setup.highest);
        }
        setup.check_law(&format!("after {before}"));
    }
}

/// Most streams have a single step, so most transitions cannot be anchors. The uniform rule lists the anchors; the other has only them.
#[test]
fn few_anchors_follow_the_law_too() {
    for alpha in [None, Some(0.5)] {
        let mut setup = Setup::new(2000, alpha, 1);
        setup.history.ends = false;
        setup.insert(0, 1, 20);
        setup.insert(1, 900, 1);
        setup.insert(2, 900, 1);
        assert_eq!((setup.anchors().len(), setup.history.inserted), (14, 1820));
        setup.learn();
        setup.check_law("few anchors");
    }
}

fn counts(replay: &Replay) -> PriorityCounts {
    replay.priority_counts().unwrap()
}

#[test]
fn a_priority_counts_once_and_for_the_transition_that_was_drawn() {
    let mut setup = Setup::new(100, Some(1.0), 1);
    setup.insert(0, 1, 60);
    let first = setup.learn().unwrap();
    let rows = u64::from(ROWS);
    assert_eq!(counts(&setup.replay).set, rows);

    let part = &first.parts[0];
    let of = |origin, number| PriorityUpdate {
        learner: LEARNER,
        number,
        parts: vec![PriorityPart {
            origin,
            transitions: part.transitions.clone(),
            priorities: vec![1e6; part.priorities.len()],
        }],
    };
    let own = part.origin;
    let earlier = Origin {
        incarnation: own.incarnation + 1,
        ..own
    };
    let other = Origin {
        shard: own.shard + 1,
        ..own
    };
    let law = setup.law();
    // The reply was lost and the learner retries; an update of an earlier incarnation; an update of another shard.
    for (update, gone, what) in [
        (of(own, first.number), 0, "after a repetition"),
        (of(earlier, 100), rows, "after what an earlier life drew"),
        (of(other, 101), rows, "after what was for others"),
    ] {
        setup.replay.set_priorities(&update).unwrap();
        let so_far = PriorityCounts {
            set: rows,
            gone,
            repeated: rows,
        };
        assert_eq!(counts(&setup.replay), so_far, "{what}");
        assert_eq!(setup.law(), law);
        setup.check_law(what);
    }

    // By now each slot holds another transition.
    setup.insert(0, 1, 100);
    setup.updates = 200;
    setup.replay.set_priorities(&of(own, 102)).unwrap();
    assert_eq!(counts(&setup.replay).gone, 2 * rows);
    setup.check_law("after what came too late");

    // Another learner numbers its updates from 1.
    let batch = setup.replay.sample(ROWS).unwrap();
    let found = [3.0; ROWS as usize];
    let update = batch.priority_update(LEARNER + 1, 1, &found).unwrap();
    setup.replay.set_priorities(&update).unwrap();
    assert_eq!(counts(&setup.replay).set, 2 * rows);
}

#[test]
fn what_was_never_stored_or_drawn_is_refused_or_ignored() {
    let mut setup = Setup::new(100, Some(0.5), 1);
    setup.insert(0, 1, 60);
    let mut update = setup.learn().unwrap();
    update.number += 1;
    update.parts[0].transitions[3] = 60;
    let refused = setup.replay.set_priorities(&update).unwrap_err();
    assert_eq!(refused, "a priority of transition 60, where 60 were stored");
    // The newest transition lacks the steps of its return.
    setup.history.ends = false;
    setup.insert(1, 1, 2);
    let gone = counts(&setup.replay).gone;
    update.parts[0].transitions[3] = 61;
    setup.replay.set_priorities(&update).unwrap();
    assert_eq!(counts(&setup.replay).gone, gone + 1);
    setup.replay.check_valid();

    let spec = setup.history.spec.clone();
    let mut uniform = Replay::new(&spec, &Config::unlimited(100), ROWS).unwrap();
    let refused = uniform.set_priorities(&update).unwrap_err();
    assert_eq!(refused, "priorities, in a run that draws uniformly");
    assert_eq!(uniform.priority_counts(), None);
}
