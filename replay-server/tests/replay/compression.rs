//! A compressed replay gives the same batches as a plain one, bit for bit, and keeps within its memory.
//! It does not test what the batches hold: `batches` does, with and without compression.

use driml_protocol::{Chunk, ChunkHeader, End, Horizon, RunSpec, TimeoutRule};
use driml_replay_server::{Compression, Config, Replay};
use proptest::prelude::*;
use rand::{Rng, RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    calls::{header, is_refused, is_stored, join},
    history::{spec, unlimited},
};

/// What frames show.
#[derive(Clone, Copy, Debug)]
enum Content {
    Noise,
    Constant,
    /// Two pictures in turn.
    Alternating,
    /// One picture that scrolls by a byte a step.
    Scrolling,
    /// Each of these for a while.
    All,
}

impl Content {
    fn fill(self, rng: &mut ChaCha8Rng, frame: &mut [u8], step: u64) {
        match self {
            Self::Noise => rng.fill_bytes(frame),
            Self::Constant => frame.fill(7),
            Self::Alternating => frame.fill(if step.is_multiple_of(2) { 3 } else { 250 }),
            Self::Scrolling => {
                for (at, byte) in frame.iter_mut().enumerate() {
                    *byte = ((at as u64 + step).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56) as u8;
                }
            }
            Self::All => {
                let kinds = [
                    Self::Noise,
                    Self::Constant,
                    Self::Alternating,
                    Self::Scrolling,
                ];
                kinds[(step / 5 % 4) as usize].fill(rng, frame, step);
            }
        }
    }
}

fn lz4(capacity_transitions: u64) -> Config {
    Config {
        compression: Compression::Lz4,
        ..unlimited(capacity_transitions)
    }
}

fn sized(height: u32, width: u32, stack: u32) -> RunSpec {
    RunSpec {
        frame_height: height,
        frame_width: width,
        ..spec(3, stack, 4, Horizon::Nhg { k_max: 5 })
    }
}

/// One actor that counts what it made.
struct Actor {
    next: ChunkHeader,
    rng: ChaCha8Rng,
}

impl Actor {
    fn new(spec: &RunSpec, streams: u32, seed: u64) -> Self {
        Self {
            next: ChunkHeader {
                weights_version: 1,
                streams,
                frame_bytes: spec.frame_bytes() as u32,
                ..header(0, 1, 0, 0)
            },
            rng: ChaCha8Rng::seed_from_u64(seed),
        }
    }

    fn chunk(&mut self, steps: u32, content: Content) -> Chunk {
        self.next.steps = steps;
        let mut chunk = Chunk::zeroed(self.next);
        for row in 0..self.next.transitions() {
            let step = self.next.first_transition + row as u64;
            content.fill(&mut self.rng, chunk.frame_mut(row), step);
            let end = match self.rng.random_range(0..20) {
                0 => End::Terminal,
                1 => End::TimedOut,
                2 => End::LevelChange,
                _ => End::Running,
            };
            let action = self.rng.random_range(0..5);
            chunk.set(row, action, self.rng.random_range(-1.0..1.0), end);
        }
        self.next.sequence += 1;
        self.next.first_transition += self.next.transitions() as u64;
        chunk
    }
}

fn store(replay: &mut Replay, chunk: &Chunk) {
    let reply = replay.insert(chunk);
    assert!(is_stored(&reply), "{reply:?}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 32, ..ProptestConfig::default() })]

    /// Through wrap-around, ends of levels and episodes, lost chunks, and drafts that are unpacked only later.
    #[test]
    fn batches_are_the_same_bit_for_bit(
        seed in any::<u64>(),
        content in prop_oneof![
            Just(Content::Noise), Just(Content::Constant), Just(Content::Alternating), Just(Content::Scrolling),
            Just(Content::All),
        ],
        // Blocks of a whole run, of 16 frames, and of frames that are longer than a part should be.
        (height, width, capacity) in prop_oneof![
            Just((4, 3, 24u64)), Just((4, 3, 200)), Just((64, 64, 60)), Just((182, 181, 30)),
        ],
        stack in prop_oneof![Just(1u32), Just(4)],
        bootstrap in any::<bool>(),
        streams in 1u32..4,
    ) {
        let mut spec = sized(height, width, stack);
        if bootstrap {
            spec.timeout = TimeoutRule::Bootstrap;
        }
        let mut plain = Replay::new(&spec, &unlimited(capacity), 16).unwrap();
        let mut packed = Replay::new(&spec, &lz4(capacity), 16).unwrap();
        join(&mut plain, 0, 1);
        join(&mut packed, 0, 1);
        let mut actor = Actor::new(&spec, streams, seed);
        let mut rng = ChaCha8Rng::seed_from_u64(!seed);
        let steps_max = (capacity / u64::from(streams)).min(21) as u32;
        for _ in 0..20 {
            if rng.random_bool(0.1) {
                // Lost on the way.
                actor.next.first_transition += 3;
            }
            let late = (plain.draw(16), packed.draw(16));
            let chunk = actor.chunk(rng.random_range(1..=steps_max), content);
            prop_assert_eq!(plain.insert(&chunk), packed.insert(&chunk));
            packed.check_valid();
            prop_assert!(late.0.map(|draft| draft.unpack()) == late.1.map(|draft| draft.unpack()));
            prop_assert!(plain.sample(16) == packed.sample(16));
        }
        let mut statuses = [plain.status(), packed.status()];
        statuses.iter_mut().for_each(|status| status.frame_bytes_held = 0);
        prop_assert_eq!(&statuses[0], &statuses[1]);
    }
}

/// Memory of a full replay: of noise not more than plain frames and a little; of what compresses far less, even after noise.
#[test]
fn memory_follows_what_is_held() {
    const CAPACITY: u64 = 1000;
    let spec = sized(64, 64, 1);
    let plain_bytes = CAPACITY * spec.frame_bytes() as u64;
    let overhead = (3 << 20) + 16 * spec.frame_bytes() as u64 + 64 * CAPACITY;
    let mut replay = Replay::new(&spec, &lz4(CAPACITY), 16).unwrap();
    join(&mut replay, 0, 1);
    let held = |replay: &Replay| replay.status().frame_bytes_held;
    assert_eq!(held(&replay), 0, "taken only as transitions come");
    let mut actor = Actor::new(&spec, 2, 1);
    for (content, most) in [
        (Content::Noise, plain_bytes + overhead),
        (Content::Alternating, overhead),
        (Content::Noise, plain_bytes + overhead),
    ] {
        for _ in 0..80 {
            store(&mut replay, &actor.chunk(8, content));
            assert!(held(&replay) <= plain_bytes + overhead);
        }
        replay.check_valid();
        assert!(held(&replay) <= most, "{content:?}: {}", held(&replay));
    }
    assert!(
        held(&replay) >= plain_bytes,
        "this cannot be all that noise"
    );
}

/// Where the bytes allowed do not suffice, the oldest go first, and what is held is sampled as ever.
#[test]
fn the_bytes_allowed_are_kept() {
    let spec = sized(64, 64, 1);
    let max = 8 << 20;
    let config = Config {
        compressed_bytes_max: Some(max),
        ..lz4(2000)
    };
    let mut replay = Replay::new(&spec, &config, 16).unwrap();
    join(&mut replay, 0, 1);
    let mut actor = Actor::new(&spec, 2, 1);
    for round in 0..120 {
        let content = match round / 40 {
            1 => Content::Constant,
            _ => Content::Noise,
        };
        let mut chunk = actor.chunk(12, content);
        // Every frame begins with its own number.
        for row in 0..24 {
            let number = round * 24 + row as u64;
            chunk.frame_mut(row)[..8].copy_from_slice(&number.to_le_bytes());
        }
        store(&mut replay, &chunk);
        replay.check_valid();
        let status = replay.status();
        assert!(status.frame_bytes_held <= max + 64 * 2000);
        let oldest = status.transitions_inserted - status.transitions_held;
        let batch = replay.sample(16).unwrap();
        for frame in batch.states_t().chunks(spec.frame_bytes()) {
            let number = u64::from_le_bytes(frame[..8].try_into().unwrap());
            assert!((oldest..status.transitions_inserted).contains(&number));
        }
        let held = status.transitions_held;
        if round == 39 || round == 119 {
            assert!((350..500).contains(&held), "{held}");
        }
    }
    let chunk = actor.chunk(250, Content::Constant);
    assert!(is_refused(&replay.insert(&chunk)));
}
