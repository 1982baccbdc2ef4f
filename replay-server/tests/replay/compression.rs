//! A compressed replay gives the same batches as a plain one, bit for bit, and respects its memory limit.
//! It does not test what the batches hold: `batches` does, with and without compression.

use driml_protocol::{Buffer, Chunk, ChunkHeader, Horizon, RunSpec};
use driml_replay_server::{Compression, Config, Replay};
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
    /// Two alternating pictures of one colour.
    Alternating,
    /// One picture that scrolls by a byte per step.
    Scrolling,
}

impl Content {
    fn fill(self, rng: &mut ChaCha8Rng, frame: &mut [u8], step: u64) {
        match self {
            Self::Noise => rng.fill_bytes(frame),
            Self::Alternating => frame.fill(if step.is_multiple_of(2) { 3 } else { 250 }),
            Self::Scrolling => {
                for (at, byte) in frame.iter_mut().enumerate() {
                    *byte = ((at as u64 + step).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56) as u8;
                }
            }
        }
    }
}

/// Makes a chunk of two environments. Every frame begins with the number of its transition.
fn chunk(header: ChunkHeader, content: Content, rng: &mut ChaCha8Rng) -> Chunk {
    let mut chunk = Chunk::zeroed(header);
    for row in 0..header.transitions() {
        let number = header.first_transition + row as u64;
        let frame = chunk.frame_mut(row);
        content.fill(rng, frame, number);
        frame[..8].copy_from_slice(&number.to_le_bytes());
        let end = random_end(rng);
        let action = rng.random_range(0..5);
        chunk.set(row, action, rng.random_range(-1.0..1.0), end);
    }
    chunk
}

/// A compressed replay without a limit in bytes holds what a plain one does, so both give the same batches. Noise takes little more memory
/// than plain frames; compressible frames take far less, even after noise. If the limit in bytes is reached, the oldest transitions are
/// dropped first, and the rest is sampled as before.
#[test]
fn batches_are_the_same_bit_for_bit_and_memory_follows_what_is_held() {
    // Blocks of 16 frames, and then frames that are longer than the limit of a part.
    for (side, stack, capacity, allowed, noise_held) in [
        (64, 1, 1000, None, 1000..1001),
        (64, 4, 1000, None, 1000..1001),
        (64, 1, 1000, Some(8 << 20), 650..690),
        (182, 1, 60, None, 60..61),
    ] {
        let spec = RunSpec {
            frame_height: side,
            frame_width: side,
            ..spec(3, stack, 4, Horizon::Nhg { k_max: 5 })
        };
        let frame_bytes = spec.frame_bytes() as u64;
        let overhead = 16 * frame_bytes + 64 * capacity;
        let most = allowed.map_or(capacity * frame_bytes + overhead, |max| max + 64 * capacity);
        let config = Config {
            compression: Compression::Lz4,
            compressed_bytes_max: allowed,
            ..Config::unlimited(capacity)
        };
        let plain = Replay::new(&spec, &Config::unlimited(capacity), 16).unwrap();
        let packed = Replay::new(&spec, &config, 16).unwrap();
        let mut replays = [plain, packed];
        replays.iter_mut().for_each(|it| join(it, 0, 1));
        let held = |packed: &Replay| packed.status().frame_bytes_held;
        assert_eq!(held(&replays[1]), 0, "taken only as transitions come");
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut actor = Actor::new(0, 1);
        actor.next.frame_bytes = spec.frame_bytes() as u32;
        for content in [
            Content::Noise,
            Content::Alternating,
            Content::Noise,
            Content::Scrolling,
        ] {
            for _ in 0..capacity / 20 {
                // Drafts that are unpacked after the next chunk was stored.
                let late = replays.each_mut().map(|it| it.draw(16, Buffer::zeroed));
                let chunk = chunk(actor.send(2, 21), content, &mut rng);
                let replies = replays.each_mut().map(|it| it.insert(&chunk));
                assert!(replies.iter().all(is_stored), "{replies:?}");
                let late = late.map(|it| it.map(|draft| draft.unpack()));
                let batches = replays.each_mut().map(|it| it.sample(16).unwrap());
                if allowed.is_none() {
                    assert!(late[0] == late[1] && batches[0] == batches[1]);
                }
                assert!(held(&replays[1]) <= most);
                let number = actor.next.first_transition;
                let oldest = number - replays[1].status().transitions_held;
                let states = batches[1].states_t();
                for frame in states.chunks(spec.frame_bytes()).filter(|_| stack == 1) {
                    let drawn = u64::from_le_bytes(frame[..8].try_into().unwrap());
                    assert!((oldest..number).contains(&drawn));
                }
            }
            let packed = &replays[1];
            packed.check_valid();
            let transitions = packed.status().transitions_held;
            match content {
                Content::Noise => {
                    assert!(noise_held.contains(&transitions), "{transitions}");
                    assert!(held(packed) >= transitions * frame_bytes, "all that noise");
                }
                Content::Alternating => {
                    assert_eq!(transitions, capacity);
                    assert!(held(packed) <= overhead, "{}", held(packed));
                }
                // Only the batches tell.
                Content::Scrolling => {}
            }
        }
        let header = actor.send(2, 7 * capacity as u32 / 20);
        let chunk = chunk(header, Content::Alternating, &mut rng);
        let reply = replays[1].insert(&chunk);
        assert_eq!(is_refused(&reply), allowed.is_some(), "{reply:?}");
    }
}
