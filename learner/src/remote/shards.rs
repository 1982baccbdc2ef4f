//! The replay's shards: joins them all, and decides how many rows of a batch come from each.
//! It fetches no batches: `fetcher` does.

use std::time::{Duration, Instant};

use driml_protocol::{
    Batch, Keys, LearnerJoin, Peer, ReplayStatus, RequestId, RunClient, ShardCounts, Shutdown,
    Silence, Waiting, join,
    session::{Connection, MESSAGE_BYTES_MAX},
};
use rand::Rng;
use zenoh::{Session, Wait, liveliness::LivelinessToken};

use super::same_run::single_run;
use crate::run_counts::{BatchPart, RunCounts};

/// Largest age at which a shard's counts are used, and the same for an empty shard.
const COUNTS_AGE_MAX: Duration = Duration::from_millis(500);
const EMPTY_COUNTS_AGE_MAX: Duration = Duration::from_millis(50);

/// Sessions with all shards of a run, in the order of their numbers, and the run's settings.
pub(crate) struct Shards {
    pub(crate) sessions: Vec<Session>,
    /// Whether each shard already knows a learner of the run.
    has_learner: Vec<bool>,
    pub(crate) config_toml: String,
}

/// The learner's membership in a run, which ends when this value is dropped.
pub(crate) struct Membership {
    /// Version of the newest weights that any shard has; 0 if none has any.
    pub(crate) weights_version: u64,
    _liveliness: Vec<LivelinessToken>,
}

impl Shards {
    /// Connects to the shard at each endpoint; `None` if the shutdown comes first.
    pub(crate) fn connect(
        connection: &Connection,
        shutdown: &Shutdown,
    ) -> anyhow::Result<Option<Self>> {
        let connect = &connection.endpoints.connect;
        let mut sessions = Vec::new();
        let mut run_infos = Vec::new();
        for endpoint in connect {
            let shard = connection.to_endpoint(endpoint);
            let Some(session) = shard.open_unless(shutdown, MESSAGE_BYTES_MAX)? else {
                return Ok(None);
            };
            let Some(run_info) = join::fetch_run_info(&session, &shard.keys, shutdown)? else {
                return Ok(None);
            };
            sessions.push(session);
            run_infos.push(run_info);
        }
        let config_toml = single_run(connect, &run_infos)?.config_toml.clone();
        // When a learner joins again, its endpoints may have another order.
        let mut shards: Vec<_> = run_infos.iter().zip(sessions).collect();
        shards.sort_by_key(|(run_info, _)| run_info.shard.0);
        let shards = shards.into_iter();
        let (has_learner, sessions) = shards
            .map(|(it, session)| (it.has_learner, session))
            .unzip();
        Ok(Some(Self {
            sessions,
            has_learner,
            config_toml,
        }))
    }

    /// A client of each shard, for the run whose spec has this hash.
    pub(crate) fn clients(&self, keys: &Keys, spec_hash: u64) -> Vec<RunClient> {
        let client = |session: &Session| RunClient::new(session.clone(), keys.clone(), spec_hash);
        self.sessions.iter().map(client).collect()
    }

    /// Joins the run as its one learner, `learner`, after `updates` updates and with the counts `counts`. `restart` restarts the run
    /// from its first update. `None` if the shutdown comes first.
    pub(crate) fn join_run(
        &self,
        clients: &[RunClient],
        learner: u64,
        (updates, counts): (u64, &RunCounts),
        restart: bool,
        shutdown: &Shutdown,
    ) -> anyhow::Result<Option<Membership>> {
        let mut membership = Membership {
            weights_version: 0,
            _liveliness: Vec::new(),
        };
        // A shard that knows the run's learner rejects a wrong one, before a shard that was started anew accepts it.
        let mut order = Vec::from_iter(0..clients.len());
        order.sort_by_key(|&shard| !self.has_learner[shard]);
        for shard in order {
            let client = &clients[shard];
            // Declared before the learner joins, so that no other learner can take its place from then on.
            let alive = client.declare_alive(Peer::learner(learner));
            let alive = alive.map_err(|e| anyhow::anyhow!("declaring the learner alive: {e}"))?;
            membership._liveliness.push(alive);
            let join = LearnerJoin {
                learner,
                run: counts.run,
                updates,
                counts: counts.shards[shard],
                other_shards: counts.other_shards(shard),
                restart,
            };
            let joined = join::join(client, &join, shutdown)?;
            let Some(welcome) = joined else {
                return Ok(None);
            };
            let newest = &mut membership.weights_version;
            *newest = welcome.weights_version.max(*newest);
        }
        Ok(Some(membership))
    }

    /// Closes all sessions; returns the first error, if there is one.
    pub(crate) fn close(&self) -> anyhow::Result<()> {
        let mut result = Ok(());
        for session in &self.sessions {
            let closed = session.close().wait();
            result = result.and(closed.map_err(|e| anyhow::anyhow!("closing the session: {e}")));
        }
        result
    }
}

/// One shard's counts, and its part of the current batch.
#[derive(Clone, Copy, Default)]
pub(super) struct ShardState {
    counts: ShardCounts,
    held: u64,
    /// When the counts arrived; `None` before the first time.
    last_seen: Option<Instant>,
    /// Rows of the batch that the shard has not sent yet.
    pub(super) pending_rows: u32,
    /// The probability with which each row was assigned to the shard.
    pub(super) share: f64,
    /// Identifier of the next request for a part.
    pub(super) id: RequestId,
}

impl ShardState {
    /// Stores what the shard has counted by now, and how many transitions it holds.
    pub(super) fn record_counts(&mut self, counts: ShardCounts, held: u64) {
        (self.counts, self.held) = (counts, held);
        self.last_seen = Some(Instant::now());
    }

    /// The same from a shard's status. A shard that has read its replay back counts too few rows until its next request. By that count,
    /// the other shards would serve more rows than the replay ratio allows.
    pub(super) fn record_status(&mut self, status: &ReplayStatus, rows_received: u64) {
        let rows_sampled = status.rows_sampled.max(rows_received);
        let counts = ShardCounts::new(status.transitions_inserted, rows_sampled);
        self.record_counts(counts, status.transitions_held);
    }

    /// Whether to fetch the counts again: other shards must not decide by old counts, and an empty shard may have received transitions.
    pub(super) fn is_stale(&self, now: Instant) -> bool {
        let age_max = if self.held == 0 {
            EMPTY_COUNTS_AGE_MAX
        } else {
            COUNTS_AGE_MAX
        };
        self.last_seen
            .is_none_or(|last_seen| now - last_seen > age_max)
    }
}

/// The one batch that is assembled from the parts of several shards. It survives a failed try, because a shard counts a part that it
/// has sent as sampled.
pub(super) struct PartialBatch {
    pub(super) shards: Vec<ShardState>,
    pub(super) parts: Vec<Batch>,
    pub(super) sources: Vec<BatchPart>,
    /// Whether all transitions of the run are stored.
    pub(super) all_stored: bool,
    /// Time since the last whole batch, or since the transitions that this batch may wait for were stored.
    pub(super) since_last_batch: Silence,
}

impl PartialBatch {
    pub(super) fn new(shard_count: usize) -> Self {
        let state = ShardState {
            id: RequestId::first(rand::random()),
            ..ShardState::default()
        };
        Self {
            shards: vec![state; shard_count],
            parts: Vec::new(),
            sources: Vec::new(),
            all_stored: false,
            since_last_batch: Silence::default(),
        }
    }

    /// Records whether the shards report that all transitions of the run are stored.
    pub(super) fn set_stored(&mut self, all_stored: bool) {
        if all_stored && !self.all_stored {
            self.all_stored = true;
            self.since_last_batch.record_answer();
        }
    }

    /// Records why a shard does not send its part yet. It knows the others' counts: if it warms up, it lost its replay and refills it.
    pub(super) fn record_waiting(&mut self, waiting: Waiting) {
        if matches!(waiting, Waiting::WarmUp { .. }) {
            self.since_last_batch.record_answer();
        }
    }

    /// Whether all rows have arrived.
    pub(super) fn is_complete(&self) -> bool {
        self.shards.iter().all(|it| it.pending_rows == 0)
    }

    /// Begins a batch of `rows` rows. Each row's shard is drawn in proportion to the transitions that the shards hold, so that all
    /// transitions of the replay are equally likely. Returns false and begins no batch if the shards are empty.
    pub(super) fn begin(&mut self, rows: u32, rng: &mut impl Rng) -> bool {
        let total: u64 = self.shards.iter().map(|it| it.held).sum();
        if total == 0 {
            return false;
        }
        for shard in &mut self.shards {
            shard.share = shard.held as f64 / total as f64;
        }
        self.assign_rows(rows, total, rng);
        true
    }

    /// Draws the shard of each of `rows` rows; all shards hold `total` transitions.
    fn assign_rows(&mut self, rows: u32, total: u64, rng: &mut impl Rng) {
        for _ in 0..rows {
            let mut transition = rng.random_range(0..total);
            for shard in &mut self.shards {
                if transition < shard.held {
                    shard.pending_rows += 1;
                    break;
                }
                transition -= shard.held;
            }
        }
    }

    /// Draws the rows of shards that cannot send any, as they hold nothing to draw from, from the other shards. The shares of all stay, because
    /// importance weights do not depend on a factor that all rows have. A shard that held nothing when the batch began gets its share now.
    pub(super) fn reassign_rows(&mut self, rng: &mut impl Rng) {
        let total: u64 = self.shards.iter().map(|it| it.held).sum();
        if total == 0 {
            return;
        }
        let empty = self.shards.iter_mut().filter(|it| it.held == 0);
        let rows = empty.map(|it| std::mem::take(&mut it.pending_rows)).sum();
        let new = self.shards.iter_mut().filter(|it| it.share == 0.0);
        new.for_each(|it| it.share = it.held as f64 / total as f64);
        self.assign_rows(rows, total, rng);
    }

    /// Abandons a batch of which no part has arrived, so that the next one is drawn anew.
    pub(super) fn abandon(&mut self) {
        self.shards.iter_mut().for_each(|it| it.pending_rows = 0);
    }

    /// The sum of the counts of all shards except `this`, as if each had already sent its pending rows.
    pub(super) fn other_shards(&self, this: usize) -> ShardCounts {
        let others = self.shards.iter().enumerate();
        let others = others.filter(|(shard, _)| *shard != this);
        others.fold(ShardCounts::default(), |sum, (_, state)| {
            let pending = ShardCounts::new(0, state.pending_rows.into());
            sum + state.counts + pending
        })
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn shard_state(held: u64, inserted: u64, rows_sampled: u64, pending_rows: u32) -> ShardState {
        ShardState {
            counts: ShardCounts::new(inserted, rows_sampled),
            held,
            pending_rows,
            ..ShardState::default()
        }
    }

    fn batch_of(shards: &[ShardState]) -> PartialBatch {
        PartialBatch {
            shards: shards.to_vec(),
            ..PartialBatch::new(0)
        }
    }

    /// Chi-square of the rows' shards against what each shard holds; 99.9% of such draws stay below the bound.
    #[test]
    fn each_transition_is_as_likely_wherever_it_lies() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let held = [1_000_000, 10, 0, 250_000, 499_990];
        let mut drawn = [0u64; 5];
        for _ in 0..4_000 {
            let mut batch = batch_of(&held.map(|held| shard_state(held, 0, 0, 0)));
            assert!(batch.begin(256, &mut rng) && !batch.is_complete());
            for (sum, state) in drawn.iter_mut().zip(&batch.shards) {
                *sum += u64::from(state.pending_rows);
            }
        }
        assert_eq!(drawn[2], 0, "nothing is drawn from an empty shard");
        let rows: u64 = drawn.iter().sum();
        assert_eq!(rows, 4_000 * 256);
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
        let mut nothing = batch_of(&[shard_state(0, 0, 0, 0)]);
        assert!(!nothing.begin(8, &mut rng) && nothing.is_complete());
    }

    #[test]
    fn rows_of_a_shard_without_any_are_drawn_from_the_others() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for (held, pending, expected) in [
            ([0, 9, 0], [5, 2, 1], [0, 8, 0]),
            ([7, 9, 0], [5, 2, 0], [5, 2, 0]),
            ([0, 0, 0], [5, 2, 1], [5, 2, 1]),
        ] {
            let states: [_; 3] = std::array::from_fn(|at| shard_state(held[at], 0, 0, pending[at]));
            let mut batch = batch_of(&states);
            batch.reassign_rows(&mut rng);
            let pending: Vec<_> = batch.shards.iter().map(|it| it.pending_rows).collect();
            assert_eq!(pending, expected, "{held:?}");
            // A row of probability 0 would have an infinite weight.
            let may_send = |it: &ShardState| it.pending_rows == 0 || it.share > 0.0;
            assert!(held == [0; 3] || batch.shards.iter().all(may_send));
        }
    }

    #[test]
    fn a_shard_is_asked_again_and_sooner_if_it_held_nothing() {
        let now = Instant::now();
        let is_stale = |held, age_ms| {
            let last_seen = now.checked_sub(Duration::from_millis(age_ms));
            ShardState {
                last_seen,
                ..shard_state(held, 0, 0, 0)
            }
            .is_stale(now)
        };
        assert!(shard_state(9, 0, 0, 0).is_stale(now), "it was never asked");
        assert!(!is_stale(9, 400) && is_stale(9, 600));
        assert!(!is_stale(0, 40) && is_stale(0, 60));
    }

    #[test]
    fn a_shard_that_restarted_has_sampled_what_came_from_it() {
        for (rows_sampled, expected) in [(64, 96), (128, 128)] {
            let mut state = shard_state(0, 0, 0, 0);
            let status = ReplayStatus {
                rows_sampled,
                ..ReplayStatus::default()
            };
            state.record_status(&status, 96);
            assert_eq!(state.counts.rows_sampled, expected);
        }
    }

    #[test]
    fn the_last_batch_is_waited_for_from_when_it_can_come() {
        let mut batch = batch_of(&[]);
        let mut restarts = |record: fn(&mut PartialBatch)| {
            while batch.since_last_batch.record_failure().is_zero() {}
            record(&mut batch);
            batch.since_last_batch.length().is_zero()
        };
        assert!(!restarts(|batch| batch.set_stored(false)));
        assert!(restarts(|batch| batch.set_stored(true)));
        assert!(!restarts(|batch| batch.set_stored(true)), "they were in");
        assert!(!restarts(
            |batch| batch.record_waiting(Waiting::LearnerWaitsForActors)
        ));
        assert!(restarts(
            |batch| batch.record_waiting(Waiting::WarmUp { have: 1, need: 2 })
        ));
    }

    #[test]
    fn a_shard_is_told_of_all_others_and_of_the_rest_of_its_batch() {
        let batch = batch_of(&[
            shard_state(1, 10, 100, 5),
            shard_state(2, 20, 200, 6),
            shard_state(3, 30, 300, 7),
        ]);
        let told = |this| {
            let others = batch.other_shards(this);
            (others.inserted, others.rows_sampled)
        };
        assert_eq!((told(1), told(2)), ((40, 412), (30, 311)));
    }
}
