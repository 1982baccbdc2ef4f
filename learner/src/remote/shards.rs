//! The replay's shards as the learner sees them: joining them all, and which rows of a batch come from which.
//! It fetches nothing: `fetcher` does.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use anyhow::{Context, ensure};
use driml_protocol::{
    Alive, Batch, Keys, LearnerJoin, RequestId, RunClient, RunInfo, ShardCounts, Shutdown, Silence,
    join,
    session::{self, Endpoints},
    tls::Credentials,
};
use rand::Rng;
use zenoh::{Session, Wait, liveliness::LivelinessToken};

use crate::progress::{Progress, ServedPart};

/// Age up to which a shard's counts are used, and that of one that holds nothing.
const AGE_MAX: Duration = Duration::from_millis(500);
const EMPTY_AGE_MAX: Duration = Duration::from_millis(50);

/// Sessions with all shards of a run, in the order of the endpoints, and what the run's settings are.
pub(crate) struct Shards {
    pub(crate) sessions: Vec<Session>,
    pub(crate) config_toml: String,
}

/// The learner's part in a run, which ends when this is dropped.
pub(crate) struct Membership {
    /// Version of the newest weights that any shard has; 0 if none has any.
    pub(crate) weights_version: u64,
    _alive: Vec<LivelinessToken>,
}

impl Shards {
    /// Joins the shard at each endpoint; `None` if told to stop before.
    pub(crate) fn join(
        connect: &[String],
        keys: &Keys,
        credentials: Option<&Arc<Credentials>>,
        shutdown: &Shutdown,
    ) -> anyhow::Result<Option<Self>> {
        let mut sessions = Vec::new();
        let mut run_infos = Vec::new();
        for endpoint in connect {
            let endpoints = Endpoints::to(vec![endpoint.clone()]);
            let max = session::MESSAGE_BYTES_MAX;
            let opened = session::open_unless(shutdown, endpoints, keys, credentials, max)?;
            let Some(session) = opened else {
                return Ok(None);
            };
            let Some(run_info) = join::run_info(&session, keys, shutdown)? else {
                return Ok(None);
            };
            sessions.push(session);
            run_infos.push(run_info);
        }
        let config_toml = one_run(connect, &run_infos)?.config_toml.clone();
        Ok(Some(Self {
            sessions,
            config_toml,
        }))
    }

    /// A client of each shard, for the run whose spec has this hash.
    pub(crate) fn clients(&self, keys: &Keys, spec_hash: u64) -> Vec<RunClient> {
        let client = |session: &Session| RunClient::new(session.clone(), keys.clone(), spec_hash);
        self.sessions.iter().map(client).collect()
    }

    /// Takes part as the run's one learner, `learner`, which is after `updates` and has counted `progress`; `restart` begins the run
    /// again. `None` if told to stop before.
    pub(crate) fn take_part(
        &self,
        clients: &[RunClient],
        learner: u64,
        (updates, progress): (u64, &Progress),
        restart: bool,
        shutdown: &Shutdown,
    ) -> anyhow::Result<Option<Membership>> {
        let mut membership = Membership {
            weights_version: 0,
            _alive: Vec::new(),
        };
        for (shard, client) in clients.iter().enumerate() {
            // Before it joins, so that no other learner can take its place from then on.
            let alive = client.declare_alive(Alive::learner(learner));
            let alive = alive.map_err(|e| anyhow::anyhow!("declaring the learner alive: {e}"))?;
            membership._alive.push(alive);
            let join = LearnerJoin {
                learner,
                run: progress.run,
                updates,
                counts: progress.shards[shard],
                other_shards: progress.other_shards(shard),
                restart,
            };
            let joined = join::take_part(client, &join, shutdown)?;
            let Some(welcome) = joined else {
                return Ok(None);
            };
            let newest = &mut membership.weights_version;
            *newest = welcome.weights_version.max(*newest);
        }
        Ok(Some(membership))
    }

    /// Closes all sessions; the first error, if there is one.
    pub(crate) fn close(&self) -> anyhow::Result<()> {
        let mut all = Ok(());
        for session in &self.sessions {
            let closed = session.close().wait();
            all = all.and(closed.map_err(|e| anyhow::anyhow!("closing the session: {e}")));
        }
        all
    }
}

/// What the shards say of the one run that they all belong to.
fn one_run<'a>(connect: &[String], run_infos: &'a [RunInfo]) -> anyhow::Result<&'a RunInfo> {
    let first = run_infos
        .first()
        .context("no endpoint of a replay server was given")?;
    for (at, run_info) in run_infos.iter().enumerate() {
        let (endpoint, shard) = (&connect[at], run_info.shard.0);
        ensure!(
            run_info.config_toml == first.config_toml,
            "{endpoint} and {} are replay servers of runs with different settings: start both with the same",
            connect[0]
        );
        if let Some(earlier) = run_infos[..at].iter().position(|it| it.shard.0 == shard) {
            anyhow::bail!(
                "{} and {endpoint} are both shard {shard}: start each replay server with its own --shard, and give each endpoint once",
                connect[earlier]
            );
        }
    }
    let count = first.shard.1 as usize;
    ensure!(
        run_infos.len() == count,
        "the run's replay has {count} shards, {} endpoints were given: give --connect once for each shard",
        run_infos.len()
    );
    Ok(first)
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Count {
    pub(crate) counts: ShardCounts,
    pub(crate) held: u64,
    /// When it said so; none before it is asked first.
    pub(crate) last_seen: Option<Instant>,
}

impl Count {
    /// Whether it is to be asked again: others must not decide by what is old, and one that held nothing may hold something now.
    pub(crate) fn is_old(&self, now: Instant) -> bool {
        let age_max = if self.held == 0 {
            EMPTY_AGE_MAX
        } else {
            AGE_MAX
        };
        self.last_seen
            .is_none_or(|last_seen| now - last_seen > age_max)
    }
}

/// How many of `rows` rows come from each shard: each row's shard is drawn in proportion to what the shards hold, so that
/// every transition of the whole replay is as likely as any other. `None` if they hold nothing.
pub(crate) fn split(rows: u32, counts: &[Count], rng: &mut impl Rng) -> Option<Vec<u32>> {
    let total: u64 = counts.iter().map(|count| count.held).sum();
    if total == 0 {
        return None;
    }
    let mut split = vec![0; counts.len()];
    for _ in 0..rows {
        let mut at = rng.random_range(0..total);
        for (n, count) in split.iter_mut().zip(counts) {
            if at < count.held {
                *n += 1;
                break;
            }
            at -= count.held;
        }
    }
    Some(split)
}

/// The chance that [`split`] gives a row to each shard.
pub(crate) fn shares(counts: &[Count]) -> Vec<f64> {
    let total: u64 = counts.iter().map(|count| count.held).sum();
    let shares = counts.iter().map(|count| count.held as f64 / total as f64);
    shares.collect()
}

/// What all shards but `this` will have counted once each has given its `pending` rows.
pub(crate) fn other_shards(counts: &[Count], pending: &[u32], this: usize) -> ShardCounts {
    let others = counts.iter().zip(pending).enumerate();
    others.filter(|(at, _)| *at != this).fold(
        ShardCounts::default(),
        |sum, (_, (count, &rows_sampled))| {
            let pending = ShardCounts {
                inserted: 0,
                rows_sampled: rows_sampled.into(),
            };
            sum + count.counts + pending
        },
    )
}

/// The one batch that is assembled from the parts of several shards. It outlives a failed try, because a part that was
/// given is counted as sampled.
pub(super) struct PartialBatch {
    pub(super) counts: Vec<Count>,
    /// Rows that are still to come from each shard.
    pub(super) pending: Vec<u32>,
    /// The chance with which each row was given to each shard.
    pub(super) shares: Vec<f64>,
    /// The request for a part that each shard gets next.
    pub(super) ids: Vec<RequestId>,
    pub(super) parts: Vec<Batch>,
    pub(super) from: Vec<ServedPart>,
    /// All transitions of the run are in.
    pub(super) all_in: bool,
    pub(super) since_whole: Silence,
}

impl PartialBatch {
    pub(super) fn new(shards: usize) -> Self {
        Self {
            counts: vec![Count::default(); shards],
            pending: vec![0; shards],
            shares: vec![0.0; shards],
            ids: vec![RequestId::first(rand::random()); shards],
            parts: Vec::new(),
            from: Vec::new(),
            all_in: false,
            since_whole: Silence::default(),
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn count(held: u64, inserted: u64, rows_sampled: u64) -> Count {
        Count {
            counts: ShardCounts {
                inserted,
                rows_sampled,
            },
            held,
            last_seen: None,
        }
    }

    /// Chi-square of the rows' shards against what each shard holds; 99.9% of such draws stay below the bound.
    #[test]
    fn each_transition_is_as_likely_wherever_it_lies() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let held = [1_000_000, 10, 0, 250_000, 499_990];
        let counts = held.map(|held| count(held, 0, 0));
        let mut drawn = [0u64; 5];
        for _ in 0..4_000 {
            let rows = split(256, &counts, &mut rng).unwrap();
            assert_eq!(rows.iter().sum::<u32>(), 256);
            drawn
                .iter_mut()
                .zip(rows)
                .for_each(|(sum, n)| *sum += u64::from(n));
        }
        assert_eq!(drawn[2], 0, "nothing is drawn from an empty shard");
        let rows: u64 = drawn.iter().sum();
        let total: u64 = held.iter().sum();
        let chi_square: f64 = drawn
            .iter()
            .zip(held)
            .filter(|(_, held)| *held > 0)
            .map(|(&drawn, held)| {
                let expected = rows as f64 * held as f64 / total as f64;
                (drawn as f64 - expected).powi(2) / expected
            })
            .sum();
        assert!(chi_square < 16.27, "3 degrees of freedom: {chi_square}");
        assert_eq!(split(8, &[count(0, 0, 0)], &mut rng), None);
    }

    #[test]
    fn a_shard_is_asked_again_and_sooner_if_it_held_nothing() {
        let now = Instant::now();
        let is_old = |held, age_ms| {
            let last_seen = now.checked_sub(Duration::from_millis(age_ms));
            Count {
                last_seen,
                ..count(held, 0, 0)
            }
            .is_old(now)
        };
        assert!(count(9, 0, 0).is_old(now), "it was never asked");
        assert!(!is_old(9, 400) && is_old(9, 600));
        assert!(!is_old(0, 40) && is_old(0, 60));
    }

    #[test]
    fn a_shard_is_told_of_all_others_and_of_the_rest_of_its_batch() {
        let counts = [count(1, 10, 100), count(2, 20, 200), count(3, 30, 300)];
        let told = |this| other_shards(&counts, &[5, 6, 7], this);
        assert_eq!(
            told(1),
            ShardCounts {
                inserted: 40,
                rows_sampled: 412
            }
        );
        assert_eq!(
            told(2),
            ShardCounts {
                inserted: 30,
                rows_sampled: 311
            }
        );
    }

    #[test]
    fn shards_that_do_not_make_one_replay_are_refused() {
        let run_info = |config: &str, shard| RunInfo {
            config_toml: config.into(),
            inserted_total: 0,
            has_learner: false,
            after_updates: 0,
            shard,
            shared_memory: true,
        };
        let connect = ["a".to_owned(), "b".to_owned()];
        let said = |run_infos: &[RunInfo]| one_run(&connect, run_infos).unwrap_err().to_string();
        assert!(
            said(&[run_info("x", (0, 2)), run_info("y", (1, 2))]).contains("different settings")
        );
        assert!(said(&[run_info("x", (1, 2)), run_info("x", (1, 2))]).contains("both shard 1"));
        assert!(said(&[run_info("x", (0, 3)), run_info("x", (1, 3))]).contains("has 3 shards"));
        assert!(said(&[run_info("x", (0, 2))]).contains("has 2 shards"));
        let whole = [run_info("x", (1, 2)), run_info("x", (0, 2))];
        assert_eq!(one_run(&connect, &whole).unwrap().config_toml, "x");
    }
}
