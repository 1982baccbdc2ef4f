//! The limiter is closed most of the time: more and more actors wait for one learner that takes batches at its pace.
//! The actors are threads of this process, each with a session, a delivery and weights of its own.

use std::{sync::atomic::AtomicU64, thread, time::Duration};

use driml_launch::status_client::Statuses;
use driml_protocol::{Quantiles, Shutdown};

use super::{
    cases::{Table, actors, seconds},
    servers::{self, Servers, Watched},
    synthetic::{self, Actor, Learner, Pace},
};
use crate::{
    flags::BenchScaleArgs,
    recording::{Recording, STREAMS},
    settings::{self, AGENT},
};

pub(super) const TITLE: &str = "Closed: replay ratio 8, actors as fast as they may, the learner at its pace with 4 MB of weights \
     every 8 batches";

/// Actors that are measured.
const ACTORS: [u32; 9] = [1, 2, 4, 8, 16, 32, 64, 128, 256];
/// Settings beside the paper's: a replay that is soon full, and no end.
const SETTINGS: [&str; 2] = [
    "replay.capacity_transitions=20000",
    "replay.transitions_max=1000000000000",
];
/// What the policy of Procgen takes.
const WEIGHTS_BYTES: usize = 4 << 20;

/// Measures every number of actors.
///
/// # Errors
/// An engine that cannot be had, a server that does not answer.
pub(super) fn measure(args: &BenchScaleArgs) -> anyhow::Result<Table> {
    let recording = Recording::play()?;
    let mut table = Table::new(&[
        "actors",
        "stored/s",
        "batches/s",
        "answer p50 ms",
        "answer p99 ms",
        "insert p50 ms",
        "insert p99 ms",
        "weights behind p50 s",
        "weights behind p99 s",
        "cores",
        "MiB",
        "retried",
        "lost",
    ]);
    for actors in actors(args, &ACTORS) {
        let Watched {
            stored,
            batches,
            cores,
            memory,
            replay,
        } = watch(args, &recording, actors)?;
        let quantiles = |it: Option<Quantiles>| [it.map(|it| it.p50), it.map(|it| it.p99)];
        let mut values = vec![Some(stored), Some(batches)];
        values.extend(quantiles(replay.answer_ms));
        values.extend(quantiles(replay.insert_ms));
        values.extend(quantiles(replay.weights_behind_s));
        values.extend([cores, memory].map(Some));
        values.extend([replay.chunks_retried, replay.transitions_lost].map(|n| Some(n as f64)));
        table.add("closed", &[actors.to_string()], &values);
    }
    Ok(table)
}

/// Starts everything anew, waits until the replay has filled, then watches it.
fn watch(args: &BenchScaleArgs, recording: &Recording, actors: u32) -> anyhow::Result<Watched> {
    let folder = tempfile::Builder::new().prefix("driml-").tempdir()?;
    let streams = STREAMS as u32;
    let mut sets = SETTINGS.map(str::to_owned).to_vec();
    sets.push(format!("actor.envs={streams}"));
    let set_words: Vec<_> = sets.iter().map(String::as_str).collect();
    let config = settings::of_run(settings::WORLD, AGENT, "paper", &set_words)?;
    let mut servers = Servers::start(1, &sets, folder.path())?;
    let mut statuses = Statuses::new(servers.sessions()?, servers.keys.clone(), config.run.hash());
    let (stop, batches) = (Shutdown::default(), AtomicU64::new(0));
    let watched = thread::scope(|scope| {
        let mut clients = Vec::new();
        let learner = Learner {
            config: &config,
            batches_a_second: args.batch_rate,
            weights_bytes: WEIGHTS_BYTES,
        };
        let (sessions, keys) = (servers.sessions()?, servers.keys.clone());
        let (stop_learning, batches) = (&stop, &batches);
        clients.push(scope.spawn(move || learner.run(sessions, keys, stop_learning, batches)));
        for actor in 0..actors {
            let session = servers.session(0)?;
            let act = Actor {
                recording,
                config: &config,
                actor,
                actors,
                streams,
                pace: Pace::Unpaced,
            };
            let (keys, stop) = (servers.keys.clone(), &stop);
            clients.push(scope.spawn(move || act.run(session, keys, stop)));
        }
        // A second for the first chunks and batches, so that all threads run and all memory is taken.
        thread::sleep(Duration::from_secs_f64(seconds(args).min(1.0)));
        let watched = servers.watch(&mut statuses, batches, seconds(args));
        stop.set();
        synthetic::join(clients)?;
        // The last word on what was lost or sent twice comes after the goodbyes.
        let mut watched = watched?;
        servers::ask(&mut statuses)?;
        watched.replay.chunks_retried = statuses.replay.chunks_retried;
        watched.replay.transitions_lost = statuses.replay.transitions_lost;
        Ok(watched)
    });
    statuses.close();
    servers.end();
    watched
}
