//! The transitions held: every frame once, in one buffer, with links along its episode.
//! It does not know actors, sampling or stacks; who follows whom is told by the caller.

use driml_protocol::End;

/// How a transition hangs together with what its stream stored before; `after` is the index of the one just before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Link {
    /// First of an episode: nothing before it counts.
    EpisodeStart,
    /// First of a level: frames before it do not count, but the return runs on from `after`.
    LevelStart { after: u64 },
    /// Within a level.
    Within { after: u64 },
    /// What came before was lost: neither frames nor return may reach back.
    Lost,
}

impl Link {
    /// The link of the transition that follows `index`, which ended `end`.
    pub(crate) const fn following(index: u64, end: End) -> Self {
        match end {
            End::Running => Self::Within { after: index },
            End::LevelChange => Self::LevelStart { after: index },
            End::TimedOut | End::Terminal => Self::EpisodeStart,
        }
    }
}

/// No successor: it has not come yet, never will, or belongs to the next episode.
const NO_NEXT: u64 = u64::MAX;
/// No predecessor: this is the first of an episode or level.
const LEVEL_START: u64 = u64::MAX;
/// The predecessor was lost on the way.
const PREVIOUS_LOST: u64 = u64::MAX - 1;

/// All of one transition but its frame: 32 bytes, so that a walk along an episode touches little memory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Step {
    next: u64,
    previous: u64,
    pub(crate) weights_version: u64,
    pub(crate) reward: f32,
    pub(crate) action: u8,
    pub(crate) end: End,
}

impl Step {
    /// A step without links.
    pub(crate) const fn new(action: u8, reward: f32, end: End, weights_version: u64) -> Self {
        Self {
            next: NO_NEXT,
            previous: LEVEL_START,
            weights_version,
            reward,
            action,
            end,
        }
    }

    /// Index of the successor in the same episode; a successor is newer, so it is held whenever this step is.
    pub(crate) const fn next(&self) -> Option<u64> {
        if self.next == NO_NEXT {
            None
        } else {
            Some(self.next)
        }
    }
}

/// What lies before a transition, as far as frames go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Previous {
    /// Nothing: it is the first of its episode or level.
    Start,
    /// A transition that is held.
    Held(u64),
    /// A transition that is overwritten or was lost.
    Gone,
}

/// The newest `capacity` transitions; number `i` since the start lies in slot `i % capacity`.
pub(crate) struct Ring {
    capacity: u64,
    frame_bytes: usize,
    inserted: u64,
    steps: Vec<Step>,
    /// Grows into its reservation, so that memory is taken only as transitions come.
    frames: Vec<u8>,
}

impl Ring {
    /// An empty ring of `capacity` frames of `frame_bytes` each.
    ///
    /// # Errors
    /// The system refuses to reserve that much memory: the bytes asked for.
    pub(crate) fn new(capacity: u64, frame_bytes: usize) -> Result<Self, u64> {
        let bytes = capacity.saturating_mul(frame_bytes as u64);
        let (mut steps, mut frames) = (Vec::new(), Vec::new());
        let reserve = |steps: &mut Vec<Step>, frames: &mut Vec<u8>| -> Option<()> {
            steps
                .try_reserve_exact(usize::try_from(capacity).ok()?)
                .ok()?;
            frames.try_reserve_exact(usize::try_from(bytes).ok()?).ok()
        };
        reserve(&mut steps, &mut frames).ok_or(bytes)?;
        Ok(Self {
            capacity,
            frame_bytes,
            inserted: 0,
            steps,
            frames,
        })
    }

    /// Stores one transition, over the oldest one once the ring is full, and gives its index.
    pub(crate) fn push(&mut self, frame: &[u8], step: Step, link: Link) -> u64 {
        assert_eq!(
            frame.len(),
            self.frame_bytes,
            "frames were measured when their chunk came"
        );
        let index = self.inserted;
        let previous = match link {
            Link::EpisodeStart | Link::LevelStart { .. } => LEVEL_START,
            Link::Within { after } => after,
            Link::Lost => PREVIOUS_LOST,
        };
        let step = Step {
            next: NO_NEXT,
            previous,
            ..step
        };
        let slot = self.slot(index);
        if slot == self.steps.len() {
            self.steps.push(step);
            self.frames.extend_from_slice(frame);
        } else {
            self.steps[slot] = step;
            self.frames[slot * self.frame_bytes..][..self.frame_bytes].copy_from_slice(frame);
        }
        self.inserted += 1;
        if let Link::Within { after } | Link::LevelStart { after } = link
            && after >= self.oldest()
        {
            let slot = self.slot(after);
            self.steps[slot].next = index;
        }
        index
    }

    fn slot(&self, index: u64) -> usize {
        (index % self.capacity) as usize
    }

    /// Most transitions held.
    pub(crate) const fn capacity(&self) -> u64 {
        self.capacity
    }

    /// Transitions stored since the start: the index of the next one.
    pub(crate) const fn inserted(&self) -> u64 {
        self.inserted
    }

    /// Index of the oldest transition held (of the next one, if none is).
    pub(crate) const fn oldest(&self) -> u64 {
        self.inserted.saturating_sub(self.capacity)
    }

    /// The step at `index`, which must be held.
    pub(crate) fn step(&self, index: u64) -> &Step {
        debug_assert!(
            (self.oldest()..self.inserted).contains(&index),
            "{index} is not held"
        );
        &self.steps[self.slot(index)]
    }

    /// The frame at `index`, which must be held.
    pub(crate) fn frame(&self, index: u64) -> &[u8] {
        debug_assert!(
            (self.oldest()..self.inserted).contains(&index),
            "{index} is not held"
        );
        &self.frames[self.slot(index) * self.frame_bytes..][..self.frame_bytes]
    }

    /// What lies before `index` in its level.
    pub(crate) fn previous(&self, index: u64) -> Previous {
        match self.step(index).previous {
            LEVEL_START => Previous::Start,
            PREVIOUS_LOST => Previous::Gone,
            previous if previous < self.oldest() => Previous::Gone,
            previous => Previous::Held(previous),
        }
    }

    /// Checks sizes and every link; panics at the first that is wrong. Slow: for tests.
    pub(crate) fn check_valid(&self) {
        let held = self.inserted - self.oldest();
        assert_eq!(self.steps.len() as u64, held, "one step a transition held");
        assert_eq!(
            self.frames.len(),
            self.steps.len() * self.frame_bytes,
            "one frame a transition held"
        );
        for index in self.oldest()..self.inserted {
            let step = self.step(index);
            if let Some(next) = step.next() {
                assert!(
                    index < next && next < self.inserted,
                    "{index} is followed by {next}"
                );
                assert!(
                    !step.end.is_episode_end(),
                    "{index} ended its episode, yet {next} follows"
                );
                let back = if step.end == End::Running {
                    index
                } else {
                    LEVEL_START
                };
                assert_eq!(self.step(next).previous, back, "{next} follows {index}");
            }
            if let Previous::Held(previous) = self.previous(index) {
                assert_eq!(
                    self.step(previous).next,
                    index,
                    "{previous} precedes {index}"
                );
                assert_eq!(
                    self.step(previous).end,
                    End::Running,
                    "{previous} precedes {index}"
                );
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{Rng, SeedableRng};

    use super::*;

    proptest! {
        /// Against a plain list of all that was ever pushed, in which every relation is searched for.
        #[test]
        fn equals_a_plain_list(seed in any::<u64>(), capacity in 1u64..40, streams in 1usize..4) {
            struct Pushed { stream: usize, frame: [u8; 2], reward: f32, end: End, cut: bool }
            let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
            let mut ring = Ring::new(capacity, 2).unwrap();
            let mut list: Vec<Pushed> = vec![];
            for index in 0..120u64 {
                let stream = rng.random_range(0..streams);
                let ends = [End::Running, End::Running, End::LevelChange, End::TimedOut, End::Terminal];
                let end = ends[rng.random_range(0..ends.len())];
                let last = list.iter().rposition(|pushed| pushed.stream == stream);
                let cut = rng.random_bool(0.1);
                let link = match last {
                    _ if cut => Link::Lost,
                    Some(last) => Link::following(last as u64, list[last].end),
                    None => Link::EpisodeStart,
                };
                let frame = rng.random::<[u8; 2]>();
                let reward = rng.random();
                prop_assert_eq!(ring.push(&frame, Step::new(3, reward, end, index), link), index);
                list.push(Pushed { stream, frame, reward, end, cut });
                ring.check_valid();
                prop_assert_eq!(ring.oldest(), (index + 1).saturating_sub(capacity));
                for i in ring.oldest()..=index {
                    let pushed = &list[i as usize];
                    prop_assert_eq!(ring.frame(i), pushed.frame);
                    let step = ring.step(i);
                    prop_assert_eq!((step.reward, step.end, step.weights_version), (pushed.reward, pushed.end, i));
                    let of_stream = |pushed: &&Pushed| pushed.stream == list[i as usize].stream;
                    let after = list.iter().skip(i as usize + 1).find(of_stream);
                    let follows = after.is_some_and(|next| !pushed.end.is_episode_end() && !next.cut);
                    let next = list.iter().skip(i as usize + 1).position(|p| p.stream == pushed.stream);
                    prop_assert_eq!(step.next(), follows.then(|| i + 1 + next.unwrap() as u64));
                    let before = list[..i as usize].iter().rposition(|p| p.stream == pushed.stream);
                    let previous = match before {
                        _ if pushed.cut => Previous::Gone,
                        Some(at) if list[at].end == End::Running && (at as u64) < ring.oldest() => Previous::Gone,
                        Some(at) if list[at].end == End::Running => Previous::Held(at as u64),
                        _ => Previous::Start,
                    };
                    prop_assert_eq!(ring.previous(i), previous);
                }
            }
        }
    }

    #[test]
    fn memory_that_is_not_there_is_an_error() {
        assert_eq!(Ring::new(1 << 50, 1 << 12).err(), Some(1 << 62));
    }
}
