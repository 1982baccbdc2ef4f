//! A compressed replay gives the same batches as a plain one, bit for bit, and respects its memory limit.
//! It does not test what the batches hold: `batches` does, with and without compression.

use driml_protocol::{Buffer, Chunk, Horizon, RunSpec, TimeoutRule};
use driml_replay_server::{Compression, Config, Replay};
use proptest::prelude::*;
use rand::{Rng, RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    calls::{Actor, is_refused, is_stored, join},
    history::{random_end, spec},
};

/// The content of frames.
#[derive(Clone, Copy, Debug)]
enum Content {
    Noise,
    Constant,
    /// Two alternating pictures.
    Alternating,
    /// One picture that scrolls by a byte per step.
    Scrolling,
    /// Each of the above for a while.
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
        ..Config::unlimited(capacity_transitions)
    }
}

fn sized(height: u32, width: u32, stack: u32) -> RunSpec {
    RunSpec {
        frame_height: height,
        frame_width: width,
        ..spec(3, stack, 4, Horizon::Nhg { k_max: 5 })
    }
}

/// An actor that generates frames.
struct Player {
    actor: Actor,
    rng: ChaCha8Rng,
}

impl Player {
    fn new(spec: &RunSpec, seed: u64) -> Self {
        let mut actor = Actor::new(0, 1);
        actor.next.frame_bytes = spec.frame_bytes() as u32;
        let rng = ChaCha8Rng::seed_from_u64(seed);
        Self { actor, rng }
    }

    fn chunk(&mut self, streams: u32, steps: u32, content: Content) -> Chunk {
        let header = self.actor.send(streams, steps);
        let mut chunk = Chunk::zeroed(header);
        for row in 0..header.transitions() {
            let step = header.first_transition + row as u64;
            content.fill(&mut self.rng, chunk.frame_mut(row), step);
            let end = random_end(&mut self.rng);
            let action = self.rng.random_range(0..5);
            chunk.set(row, action, self.rng.random_range(-1.0..1.0), end);
        }
        chunk
    }
}

fn store(replay: &mut Replay, chunk: &Chunk) {
    let reply = replay.insert(chunk);
    assert!(is_stored(&reply), "{reply:?}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 32, ..ProptestConfig::default() })]

    /// Covers wrap-around, ends of levels and episodes, lost chunks, and drafts that are unpacked later.
    #[test]
    fn batches_are_the_same_bit_for_bit(
        seed in any::<u64>(),
        // Blocks that hold a whole chunk of a stream, blocks of 16 frames, and frames that are longer than the limit of a part.
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
        let mut plain = Replay::new(&spec, &Config::unlimited(capacity), 16).unwrap();
        let mut packed = Replay::new(&spec, &lz4(capacity), 16).unwrap();
        join(&mut plain, 0, 1);
        join(&mut packed, 0, 1);
        let mut player = Player::new(&spec, seed);
        let mut rng = ChaCha8Rng::seed_from_u64(!seed);
        let steps_max = (capacity / u64::from(streams)).min(21) as u32;
        for _ in 0..20 {
            if rng.random_bool(0.1) {
                // Three transitions are lost.
                player.actor.next.first_transition += 3;
            }
            let late = (plain.draw(16, Buffer::zeroed), packed.draw(16, Buffer::zeroed));
            let chunk = player.chunk(streams, rng.random_range(1..=steps_max), Content::All);
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

/// The memory of a full replay: noise takes little more than plain frames; compressible frames take far less, even after noise. If the
/// limit in bytes is reached, the oldest transitions are dropped first, and the rest is sampled as before.
#[test]
fn memory_follows_what_is_held_and_the_bytes_allowed_are_kept() {
    const CAPACITY: u64 = 1000;
    let spec = sized(64, 64, 1);
    let frame_bytes = spec.frame_bytes() as u64;
    let overhead = 16 * frame_bytes + 64 * CAPACITY;
    let (all, max) = (CAPACITY * frame_bytes + overhead, 8 << 20);
    let (all_held, some_held) = (CAPACITY..CAPACITY + 1, 650..690);
    for (allowed, most, noise_held) in [
        (None, all, all_held.clone()),
        (Some(max), max + 64 * CAPACITY, some_held),
    ] {
        let config = Config {
            compressed_bytes_max: allowed,
            ..lz4(CAPACITY)
        };
        let mut replay = Replay::new(&spec, &config, 16).unwrap();
        join(&mut replay, 0, 1);
        let held = |replay: &Replay| replay.status().frame_bytes_held;
        assert_eq!(held(&replay), 0, "taken only as transitions come");
        let (mut player, mut number) = (Player::new(&spec, 1), 0_u64);
        for content in [Content::Noise, Content::Alternating, Content::Noise] {
            for _ in 0..50 {
                let mut chunk = player.chunk(2, 12, content);
                // Every frame begins with its number.
                for row in 0..24 {
                    chunk.frame_mut(row)[..8].copy_from_slice(&number.to_le_bytes());
                    number += 1;
                }
                store(&mut replay, &chunk);
                assert!(held(&replay) <= most);
                let oldest = number - replay.status().transitions_held;
                let batch = replay.sample(16).unwrap();
                for frame in batch.states_t().chunks(spec.frame_bytes()) {
                    let drawn = u64::from_le_bytes(frame[..8].try_into().unwrap());
                    assert!((oldest..number).contains(&drawn));
                }
            }
            replay.check_valid();
            let transitions = replay.status().transitions_held;
            if matches!(content, Content::Noise) {
                assert!(noise_held.contains(&transitions), "{transitions}");
                assert!(held(&replay) >= transitions * frame_bytes, "all that noise");
            } else {
                assert!(all_held.contains(&transitions), "{transitions}");
                assert!(held(&replay) <= overhead, "{}", held(&replay));
            }
        }
        let chunk = player.chunk(2, 350, Content::Constant);
        assert_eq!(is_refused(&replay.insert(&chunk)), allowed.is_some());
    }
}
