//! Batches put together inside the replay server, without wire and codec, and as many bytes merely copied.
//! It starts no process.

use std::hint::black_box;

use anyhow::{bail, ensure};
use driml_protocol::{ActorJoin, BufferPool, InsertReply};
use driml_replay_server::Replay;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    effort::Effort,
    measurements::Measurement,
    recording::Recording,
    settings::{self, AGENT, CAPACITY},
    taking_part::INCARNATION,
};

/// Batches a second.
///
/// # Errors
/// A replay that does not store or sample.
pub(super) fn measure(recording: &Recording, effort: &Effort) -> anyhow::Result<[Measurement; 2]> {
    let config = settings::of_run(settings::WORLD, AGENT, "paper", &settings::REPLAY)?;
    let (rows, frame_bytes) = (config.learner.batch_size, recording.frame_bytes());
    let mut replay = Replay::new(&config.run, &config.replay, rows)?;
    let join = ActorJoin {
        actor: 0,
        incarnation: INCARNATION,
    };
    replay.join_actor(join).map_err(anyhow::Error::msg)?;
    for chunk in recording.chunks(0, (8, 32), BufferPool::new(1)) {
        match replay.insert(&chunk) {
            InsertReply::Stored { inserted_total, .. } if inserted_total >= CAPACITY => break,
            reply => ensure!(matches!(reply, InsertReply::Stored { .. }), "{reply:?}"),
        }
    }
    let sampling = effort.rate_by_median(|| match replay.sample(rows) {
        Ok(batch) => {
            black_box(batch);
            Ok(())
        }
        Err(why) => bail!("no batch: {why:?}"),
    })?;
    drop(replay);

    let held = vec![1_u8; CAPACITY as usize * frame_bytes];
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let copying = effort.rate_by_median(|| {
        let mut copy = Vec::with_capacity(3 * rows as usize * frame_bytes);
        for _ in 0..3 * rows {
            let from = rng.random_range(0..CAPACITY as usize) * frame_bytes;
            copy.extend_from_slice(&held[from..from + frame_bytes]);
        }
        black_box(copy);
        Ok::<_, anyhow::Error>(())
    })?;
    Ok([
        Measurement::found("batch of 3 states, without a wire", sampling, "batches/s"),
        Measurement::found("plain copy of a batch's bytes", copying, "batches/s"),
    ])
}
