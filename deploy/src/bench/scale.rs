//! Replay servers under more and more actors: what they store and serve, and what it costs them, until they cannot keep up.
//! The actors and the learner are synthetic and paced, but they speak through the real delivery and batch source.

use std::{
    path::Path,
    sync::atomic::{AtomicU64, Ordering},
    thread,
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use driml_actor::{
    ActorSettings,
    delivery::{Delivery, DeliveryLimits},
};
use driml_learner::{
    LearnerPart,
    batch_source::{BatchSource, Next, Requests},
};
use driml_protocol::{
    Keys, Shutdown,
    session::{self, Endpoints},
};
use nix::unistd::{SysconfVar, sysconf};
use zenoh::{Session, Wait};

use crate::{
    bench::{
        figures::{self, Figure, MachineNote},
        recording::Recording,
        replay::{AGENT, SETTINGS, reach},
        settings, table, taking_part,
    },
    child::{Part, Surroundings},
    cli::{BenchScaleArgs, NAMESPACE},
    config::RunConfig,
    console::{self, Screen},
    statuses::Statuses,
};

/// Shards and actors that are measured.
const SHARDS: [u32; 3] = [1, 2, 4];
const ACTORS: [u32; 7] = [1, 2, 4, 8, 16, 32, 64];
/// Streams and steps of a chunk: what an actor of 16 copies sends in the paper's settings.
const CHUNK: (u32, u32) = (8, 32);
/// How long a server may take to listen, and a batch to come.
const ANSWER_MAX: Duration = Duration::from_secs(30);
/// Share of what is offered that must be stored for the servers to keep up.
const KEEPS_UP: f64 = 0.9;

/// What some servers did under some actors.
struct Load {
    shards: u32,
    actors: u32,
    /// Transitions a second that the actors would send.
    offered: f64,
    /// Transitions a second that were stored.
    stored: f64,
    /// Batches a second that the learner got.
    batches: f64,
    /// Cores that the servers used.
    cores: f64,
    /// Highest resident memory of the servers together, MiB.
    memory: f64,
}

/// Measures every number of actors and shards, and reports.
///
/// # Errors
/// An engine that cannot be had, a server that does not answer, a file that cannot be written.
pub(super) fn run(args: &BenchScaleArgs, machine: MachineNote) -> anyhow::Result<()> {
    let recording = Recording::play()?;
    let (seconds, actors) = match args.flags.quick {
        true => (2.0, &ACTORS[..2]),
        false => (args.seconds, &ACTORS[..]),
    };
    let mut loads = Vec::new();
    for shards in SHARDS {
        for &actors in actors.iter().filter(|&&actors| actors >= shards) {
            let load = measure(args, &recording, seconds, shards, actors)?;
            console::line(&format!("  {}", load.words().join("  ")));
            loads.push(load);
        }
    }
    let mut rows = vec![Load::heads()];
    rows.extend(loads.iter().map(Load::words));
    let mut text = table::aligned(&rows, &[0, 1, 2, 3, 4, 5, 6]);
    for shards in SHARDS {
        text.push_str(&limit(&loads, shards));
    }
    let figures: Vec<_> = loads.iter().flat_map(Load::figures).collect();
    figures::report_as("scale", &figures, &text, machine, &args.flags)
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

impl Load {
    fn heads() -> Vec<String> {
        let heads = [
            "shards",
            "actors",
            "offered/s",
            "stored/s",
            "batches/s",
            "cores",
            "MiB",
        ];
        heads.map(str::to_owned).to_vec()
    }

    fn words(&self) -> Vec<String> {
        let Self {
            shards,
            actors,
            offered,
            stored,
            batches,
            cores,
            memory,
        } = self;
        let mut words = vec![shards.to_string(), actors.to_string()];
        words.extend([offered, stored, batches, cores, memory].map(|&it| table::number(it)));
        words
    }

    fn figures(&self) -> [Figure; 5] {
        let name = |what: &str| format!("{what}, {} actors, {} shards", self.actors, self.shards);
        [
            ("offered", self.offered, "transitions/s"),
            ("stored", self.stored, "transitions/s"),
            ("batches", self.batches, "batches/s"),
            ("servers' processor time", self.cores, "cores"),
            ("servers' memory", self.memory, "MiB"),
        ]
        .map(|(what, value, unit)| Figure {
            what: name(what),
            value,
            unit: unit.into(),
        })
    }
}

/// Starts everything anew, lets it run for a moment, then watches it for `seconds`.
fn measure(
    args: &BenchScaleArgs,
    recording: &Recording,
    seconds: f64,
    shards: u32,
    actors: u32,
) -> anyhow::Result<Load> {
    let folder = tempfile::Builder::new().prefix("driml-").tempdir()?;
    let sets: Vec<_> = SETTINGS
        .iter()
        .map(|&set| set.to_owned())
        .chain([format!("replay.shards={shards}")])
        .collect();
    let set_words: Vec<_> = sets.iter().map(String::as_str).collect();
    let config = settings::of_run(settings::WORLD, AGENT, "paper", &set_words)?;
    let mut servers = Servers::start(shards, &sets, folder.path())?;
    let mut statuses = Statuses::new(servers.sessions()?, servers.keys.clone(), config.run.hash());
    let stop = Shutdown::default();
    let batches = AtomicU64::new(0);
    let load = thread::scope(|scope| {
        let mut clients = Vec::new();
        for actor in 0..actors {
            let session = servers.session(actor % shards)?;
            let (config, keys, stop) = (&config, servers.keys.clone(), stop.clone());
            clients.push(scope.spawn(move || {
                act(
                    args,
                    recording,
                    config,
                    (actor, actors),
                    (session, keys),
                    &stop,
                )
            }));
        }
        let (sessions, keys) = (servers.sessions()?, servers.keys.clone());
        let (config, learner_stop, count) = (&config, stop.clone(), &batches);
        clients.push(scope.spawn(move || {
            learn(
                args.batch_rate,
                config,
                (sessions, keys),
                &learner_stop,
                count,
            )
        }));

        // A second for the first chunks and batches, so that all threads run and all memory is taken.
        thread::sleep(Duration::from_secs_f64(seconds.min(1.0)));
        let watched = servers.watch(&mut statuses, &batches, seconds);
        stop.set();
        for client in clients {
            client
                .join()
                .map_err(|_| anyhow::anyhow!("a client panicked"))??;
        }
        watched
    });
    statuses.close();
    servers.end();
    let mut load = load?;
    (load.shards, load.actors) = (shards, actors);
    load.offered = f64::from(actors) * args.actor_rate;
    Ok(load)
}

/// Sends chunks at the pace of one of `actors` actors, until told to stop.
fn act(
    args: &BenchScaleArgs,
    recording: &Recording,
    config: &RunConfig,
    (actor, actors): (u32, u32),
    (session, keys): (Session, Keys),
    stop: &Shutdown,
) -> anyhow::Result<()> {
    let settings = ActorSettings::from_toml(&config.to_toml())?;
    let pool = settings.chunk_memory();
    taking_part::join_as_actor(&session, &keys, settings.spec.hash(), actor)?;
    let delivery = Delivery::start(
        session.clone(),
        keys,
        settings.spec.hash(),
        0,
        DeliveryLimits::of(&settings.actor),
        pool.clone(),
        Shutdown::default(),
    )?;
    let each = Duration::from_secs_f64(f64::from(CHUNK.0 * CHUNK.1) / args.actor_rate);
    // Real actors do not send all at once.
    let mut due = Instant::now() + each.mul_f64(f64::from(actor) / f64::from(actors));
    for chunk in recording.chunks(actor, CHUNK, pool) {
        if stop.wait_timeout(due.saturating_duration_since(Instant::now())) {
            break;
        }
        if !delivery.send(chunk) {
            break;
        }
        // One that has fallen behind does not catch up: its world would have waited too.
        due = (due + each).max(Instant::now());
    }
    delivery.finish()?;
    session
        .close()
        .wait()
        .map_err(|e| anyhow::anyhow!("closing an actor's session: {e}"))
}

/// Takes batches at the pace of a learner, until told to stop.
fn learn(
    rate: f64,
    config: &RunConfig,
    (sessions, keys): (Vec<Session>, Keys),
    stop: &Shutdown,
    count: &AtomicU64,
) -> anyhow::Result<()> {
    let LearnerPart {
        spec,
        learner,
        transport,
        ..
    } = LearnerPart::from_toml(&config.to_toml())?;
    for session in &sessions {
        taking_part::join_as_learner(session, &keys, spec.hash())?;
    }
    let requests = Requests {
        learner: taking_part::LEARNER,
        rows: learner.batch_rows,
        in_flight: learner.batches_in_flight,
        shared_memory: transport.shared_memory,
        unreachable_max: ANSWER_MAX,
    };
    let mut source = BatchSource::start(&sessions, &keys, spec.hash(), requests, stop)?;
    let mut due = Instant::now();
    while !stop.wait_timeout(due.saturating_duration_since(Instant::now())) {
        if let Next::Batch(_) = source.next(ANSWER_MAX)? {
            count.fetch_add(1, Ordering::Relaxed);
        }
        due = (due + Duration::from_secs_f64(1.0 / rate)).max(Instant::now());
    }
    for session in &sessions {
        session
            .close()
            .wait()
            .map_err(|e| anyhow::anyhow!("closing the learner's session: {e}"))?;
    }
    source.end();
    Ok(())
}

/// The replay servers that are measured.
struct Servers {
    parts: Vec<Part>,
    endpoints: Vec<String>,
    keys: Keys,
}

impl Servers {
    fn start(shards: u32, sets: &[String], folder: &Path) -> anyhow::Result<Self> {
        let (mut parts, mut endpoints) = (Vec::new(), Vec::new());
        for shard in 0..shards {
            let name = format!("replay-server-{shard}");
            let socket = folder.join(format!("{shard}.sock"));
            let endpoint = format!("unixsock-stream/{}", socket.display());
            let shard = shard.to_string();
            let words = ["replay-server", "--listen", &endpoint];
            let run = [
                "--shard",
                &shard,
                "--env",
                settings::WORLD,
                "--agent",
                AGENT,
            ];
            let args: Vec<String> = words
                .into_iter()
                .chain(run)
                .chain(sets.iter().flat_map(|set| ["--set", set.as_str()]))
                .map(Into::into)
                .collect();
            let surroundings = Surroundings {
                logs: folder,
                screen: &Screen::plain(),
                meeting: None,
            };
            let mut part = Part::start(&name, &args, 1, surroundings)?;
            let session = reach(&endpoint, &mut part)?;
            if let Err(e) = session.close().wait() {
                tracing::debug!("closing a session: {e}");
            }
            parts.push(part);
            endpoints.push(endpoint);
        }
        Ok(Self {
            parts,
            endpoints,
            keys: Keys::new(NAMESPACE).map_err(anyhow::Error::msg)?,
        })
    }

    fn session(&self, shard: u32) -> anyhow::Result<Session> {
        Ok(session::open(&Endpoints {
            listen: Vec::new(),
            connect: vec![self.endpoints[shard as usize].clone()],
        })?)
    }

    fn sessions(&self) -> anyhow::Result<Vec<Session>> {
        (0..self.parts.len() as u32)
            .map(|shard| self.session(shard))
            .collect()
    }

    /// What happens in the next `seconds`.
    fn watch(
        &mut self,
        statuses: &mut Statuses,
        batches: &AtomicU64,
        seconds: f64,
    ) -> anyhow::Result<Load> {
        let mut moment = |servers: &mut Self| -> anyhow::Result<(Instant, u64, u64, f64)> {
            statuses.ask_replay()?;
            let stored = statuses.replay.transitions_inserted;
            let served = batches.load(Ordering::Relaxed);
            Ok((Instant::now(), stored, served, servers.processor_seconds()?))
        };
        let (started, stored, served, busy) = moment(self)?;
        thread::sleep(Duration::from_secs_f64(seconds));
        let (ended, stored_after, served_after, busy_after) = moment(self)?;
        let elapsed = (ended - started).as_secs_f64();
        let memory = self.parts.iter_mut().map(Part::rss_mib);
        Ok(Load {
            shards: 0,
            actors: 0,
            offered: 0.0,
            stored: (stored_after - stored) as f64 / elapsed,
            batches: (served_after - served) as f64 / elapsed,
            cores: (busy_after - busy) / elapsed,
            memory: memory.map(Option::unwrap_or_default).sum(),
        })
    }

    /// Processor time of all servers so far.
    fn processor_seconds(&mut self) -> anyhow::Result<f64> {
        let ticks_a_second = sysconf(SysconfVar::CLK_TCK)?.context("the system's clock ticks")?;
        let mut ticks = 0;
        for part in &mut self.parts {
            if part.end().is_some() {
                bail!("{}", part.obituary());
            }
            let path = format!("/proc/{}/stat", part.pid());
            let stat = std::fs::read_to_string(&path).with_context(|| format!("reading {path}"))?;
            ticks +=
                processor_ticks(&stat).with_context(|| format!("{path} is not as expected"))?;
        }
        Ok(ticks as f64 / ticks_a_second as f64)
    }

    fn end(&mut self) {
        for part in &mut self.parts {
            part.ask_to_stop();
            part.wait_until(Instant::now() + ANSWER_MAX, || false);
        }
    }
}

/// Clock ticks in user and system mode, from `/proc/PID/stat`.
fn processor_ticks(stat: &str) -> Option<u64> {
    // The second field is a name in brackets that may hold anything.
    let (_, fields) = stat.rsplit_once(')')?;
    let mut fields = fields.split_whitespace().skip(11);
    let mut next = || fields.next()?.parse::<u64>().ok();
    Some(next()? + next()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processor_time_is_read_past_any_name() {
        let stat = "7 (a ) b) S 1 1 1 0 -1 4194560 9 0 0 0 150 25 0 0 20 0 8 0 100 1 1";
        assert_eq!(processor_ticks(stat), Some(175));
        assert_eq!(processor_ticks("7 (x) S 1"), None);
    }

    #[test]
    fn the_limit_is_where_less_is_stored_than_offered() {
        let load = |actors, stored| Load {
            shards: 1,
            actors,
            offered: 1000.0 * f64::from(actors),
            stored,
            batches: 0.0,
            cores: 0.0,
            memory: 0.0,
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
