//! The limiter never closes: paced actors and a paced learner, until the servers cannot keep up.
//! What a closed limiter does to the actors is `closed`.

use std::{sync::atomic::AtomicU64, thread, time::Duration};

use driml_launch::status_client::Statuses;
use driml_protocol::Shutdown;

use super::{
    cases::{Table, actors, seconds},
    servers::{Servers, Watched},
    synthetic::{self, Learner, Pace},
};
use crate::{
    flags::BenchScaleArgs,
    recording::Recording,
    settings::{self, AGENT, REPLAY},
};

pub(super) const TITLE: &str =
    "Open: each actor sends at its pace, the learner asks at its own, nobody waits at the limiter";

/// Shards and actors that are measured.
const SHARDS: [u32; 3] = [1, 2, 4];
const ACTORS: [u32; 7] = [1, 2, 4, 8, 16, 32, 64];
/// Streams and steps of a chunk: what an actor of 16 copies sends in the paper's settings.
const CHUNK: (u32, u32) = (8, 32);
/// Share of what is offered that must be stored for the servers to keep up.
const KEEPS_UP: f64 = 0.9;

/// What some servers stored of what some actors offered, transitions a second.
struct Load {
    shards: u32,
    actors: u32,
    offered: f64,
    stored: f64,
}

/// Measures every number of actors and shards.
///
/// # Errors
/// An engine that cannot be had, a server that does not answer.
pub(super) fn measure(args: &BenchScaleArgs) -> anyhow::Result<Table> {
    let recording = Recording::play()?;
    let mut table = Table::new(&[
        "shards",
        "actors",
        "offered/s",
        "stored/s",
        "batches/s",
        "cores",
        "MiB",
    ]);
    let mut loads = Vec::new();
    let all = actors(args, &ACTORS);
    for shards in SHARDS {
        for &actors in all.iter().filter(|&&actors| actors >= shards) {
            let watched = watch(args, &recording, shards, actors)?;
            let offered = f64::from(actors) * args.actor_rate;
            let Watched {
                stored,
                batches,
                cores,
                memory,
                ..
            } = watched;
            let values = [offered, stored, batches, cores, memory].map(Some);
            table.add("open", &[shards.to_string(), actors.to_string()], &values);
            loads.push(Load {
                shards,
                actors,
                offered,
                stored,
            });
        }
    }
    table.notes = SHARDS.iter().map(|&shards| limit(&loads, shards)).collect();
    Ok(table)
}

/// Up to how many of the actors `shards` servers keep up.
fn limit(loads: &[Load], shards: u32) -> String {
    let of: Vec<_> = loads.iter().filter(|load| load.shards == shards).collect();
    let behind = of.iter().find(|load| load.stored < KEEPS_UP * load.offered);
    let servers = match shards {
        1 => "1 server".into(),
        shards => format!("{shards} servers"),
    };
    match (behind, of.last()) {
        (Some(load), _) => format!(
            "{servers}: {} actors are more than can be kept up with on this machine\n",
            load.actors
        ),
        (None, Some(load)) => format!("{servers}: up to {} actors are kept up with\n", load.actors),
        (None, None) => String::new(),
    }
}

/// Starts everything anew, lets it run for a moment, then watches it.
fn watch(
    args: &BenchScaleArgs,
    recording: &Recording,
    shards: u32,
    actors: u32,
) -> anyhow::Result<Watched> {
    let folder = tempfile::Builder::new().prefix("driml-").tempdir()?;
    let sets: Vec<_> = REPLAY
        .iter()
        .map(|&set| set.to_owned())
        .chain([format!("replay.shards={shards}")])
        .collect();
    let set_words: Vec<_> = sets.iter().map(String::as_str).collect();
    let config = settings::of_run(settings::WORLD, AGENT, "paper", &set_words)?;
    let mut servers = Servers::start(shards, &sets, folder.path())?;
    let mut statuses = Statuses::new(servers.sessions()?, servers.keys.clone(), config.run.hash());
    let (stop, batches) = (Shutdown::default(), AtomicU64::new(0));
    let watched = thread::scope(|scope| {
        let mut clients = Vec::new();
        for actor in 0..actors {
            let session = servers.session(actor % shards)?;
            let each = Duration::from_secs_f64(f64::from(CHUNK.0 * CHUNK.1) / args.actor_rate);
            let act = synthetic::Actor {
                recording,
                config: &config,
                actor,
                actors,
                streams: CHUNK.0,
                pace: Pace::Every {
                    steps: CHUNK.1,
                    period: each,
                    // Real actors do not send all at once.
                    first: each.mul_f64(f64::from(actor) / f64::from(actors)),
                },
            };
            let (keys, stop) = (servers.keys.clone(), &stop);
            clients.push(scope.spawn(move || act.run(session, keys, stop)));
        }
        let learner = Learner {
            config: &config,
            batches_a_second: args.batch_rate,
            weights_bytes: 0,
        };
        let (sessions, keys) = (servers.sessions()?, servers.keys.clone());
        let (stop_learning, batches) = (&stop, &batches);
        clients.push(scope.spawn(move || learner.run(sessions, keys, stop_learning, batches)));

        // A second for the first chunks and batches, so that all threads run and all memory is taken.
        thread::sleep(Duration::from_secs_f64(seconds(args).min(1.0)));
        let watched = servers.watch(&mut statuses, batches, seconds(args));
        stop.set();
        synthetic::join(clients)?;
        watched
    });
    statuses.close();
    servers.end();
    watched
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_is_where_less_is_stored_than_offered() {
        let load = |actors, stored| Load {
            shards: 1,
            actors,
            offered: 1000.0 * f64::from(actors),
            stored,
        };
        let loads = [load(1, 990.0), load(2, 1700.0), load(4, 1700.0)];
        assert_eq!(
            limit(&loads, 1),
            "1 server: 2 actors are more than can be kept up with on this machine\n"
        );
        assert_eq!(
            limit(&loads[..1], 1),
            "1 server: up to 1 actors are kept up with\n"
        );
        assert_eq!(limit(&loads, 2), "");
    }
}
