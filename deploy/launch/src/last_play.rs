//! Plays a finished run's weights greedily, and a random policy for comparison. The return is the number that the run was for.
//! A failure in this module does not fail the run: it is reported as a line on stderr.

use std::time::{Duration, Instant};

use anyhow::ensure;
use driml_protocol::Shutdown;
use driml_settings::config::RunConfig;

use crate::{
    checkpoint_choice::{CheckpointChoice, WeightsChoice},
    console,
    evaluate::{Levels, Player, PolicyKind},
    run_folder::{LastPlay, ReturnInterval, RunFolder, Summary},
};

/// Episodes played at once, one per environment. A batch counts as a whole, so that long episodes are not left out.
const BATCH: usize = 20;
const BATCHES_MAX: u32 = 5;
/// Time limit for all batches; the first batch may take longer.
const PLAY_MAX: Duration = Duration::from_secs(30);
const FIRST_BATCH_MAX: Duration = Duration::from_secs(120);

/// Plays the weights of a finished run and adds their returns to its summary, if the settings ask for it. Plays on a
/// thread, so that a `shutdown` also ends the wait for a world that hangs.
pub(crate) fn play(
    summary: &mut Summary,
    config: &RunConfig,
    folder: &RunFolder,
    shutdown: &Shutdown,
) {
    if !config.local.play {
        return;
    }
    console::eprintln(
        "playing the weights beside a random policy, for at most about 30 s (skip it with Ctrl-C or --no-play)",
    );
    let (run, flag) = (folder.clone(), shutdown.clone());
    let work = move || played(&run, &flag);
    let played = shutdown.run_unless_set("last-play", work, || false);
    let played = played.map_err(anyhow::Error::from);
    let noted = played.and_then(|played| {
        summary.played = played.transpose()?.flatten();
        summary.write(folder)
    });
    if let Err(e) = noted {
        console::eprintln(&format!(
            "the run is finished, but playing its weights failed: {}; `driml evaluate {}` plays them again",
            console::describe_error(&e),
            folder.quoted()
        ));
    }
}

/// What the weights in `folder` earn; none if stopped before the first batch was complete.
fn played(folder: &RunFolder, stop: &Shutdown) -> anyhow::Result<Option<LastPlay>> {
    let started = Instant::now();
    let player = Player::load(folder, CheckpointChoice::Newest, WeightsChoice::Average)?;
    let is_over = || stop.is_set() || started.elapsed() > FIRST_BATCH_MAX;
    let (mut agent, mut random) = (Vec::new(), Vec::new());
    for batch in 0..BATCHES_MAX {
        // The next batch takes about as long as the mean batch before it.
        if batch > 0 && started.elapsed() * (batch + 1) > PLAY_MAX * batch {
            break;
        }
        let play = |policy| player.returns(policy, Levels::Train, BATCH, batch.into(), is_over);
        let both = [play(PolicyKind::Agent)?, play(PolicyKind::Random)?];
        if both.iter().any(|returns| returns.len() < BATCH) {
            break;
        }
        let [agent_returns, random_returns] = both;
        agent.extend(agent_returns);
        random.extend(random_returns);
    }
    if agent.is_empty() {
        let max = FIRST_BATCH_MAX.as_secs();
        ensure!(stop.is_set(), "{BATCH} episodes take longer than {max} s");
        return Ok(None);
    }
    Ok(Some(LastPlay {
        weights: player.weights_name().into(),
        episodes: agent.len() as u64,
        agent: ReturnInterval::new(&agent),
        random: ReturnInterval::new(&random),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        run_folder::{Outcome, ResumePoint},
        run_view::{Plan, RunView},
        testing::config,
    };

    #[test]
    fn what_cannot_be_played_fails_no_run() {
        let mut config = config("smoke", "chain", "c51", &[]);
        assert!(!config.local.play, "a test run is not played");
        config.local.play = true;
        let view = RunView::new(Plan::new(&config));
        let mut summary = Summary::new(Outcome::Finished, &view, 2.0, ResumePoint::default());
        let before = summary.clone();
        let folder = RunFolder::new("no-such-run");
        play(&mut summary, &config, &folder, &Shutdown::default());
        assert!(played(&folder, &Shutdown::default()).is_err());
        assert_eq!(summary, before);
    }
}
