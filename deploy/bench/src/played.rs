//! Updates on batches that a world gives, with what a scene does not need left out and without.
//! The frames are played at random and the weights are not trained: an agent that has learned sees other states.

use driml_envs::WorldName;
use driml_launch::inspect::Inspection;
use driml_learner::{DeviceName, Learner, LearnerConfig, LearnerError, Precision};
use driml_protocol::Batch;
use driml_settings::config::RunConfig;

use crate::{
    effort::Effort,
    measurements::{Measurement, named},
    settings,
};

/// A replay of 20,000 frames that random actions gave, as `driml inspect --worlds --play` has it.
const SETS: [&str; 4] = [
    "replay.transitions_max=21000",
    "replay.warmup_transitions=20000",
    "actor.epsilon_start=1",
    "actor.epsilon_end=1",
];
/// Batches that updates take in turn.
const BATCHES: usize = 4;
/// What is measured: its name, whether frames are whole, and what is done with equal states.
const CASES: [(&str, bool, &str); 3] = [
    ("whole frames, each state", true, "each"),
    ("each state", false, "each"),
    ("equal states once", false, "once"),
];

/// Updates a second of `driml-ada` in each of `worlds`. The cases take turns, so that a load of the machine meets them alike.
///
/// # Errors
/// A world that cannot be had, an update that failed.
pub(super) fn measure(
    worlds: &[WorldName],
    effort: &Effort,
    device: DeviceName,
    precision: Precision,
) -> anyhow::Result<Vec<Measurement>> {
    let compute = device.open(precision)?;
    let mut figures = Vec::new();
    for world in worlds {
        let of_run = |whole: bool, sets: &[&str]| -> anyhow::Result<RunConfig> {
            let sets = [&SETS[..], sets].concat();
            let config = settings::of_run(&world.to_string(), settings::AGENT, "paper", &sets)?;
            Ok(if whole {
                config.with_whole_frames()?
            } else {
                config
            })
        };
        let played = |whole| -> anyhow::Result<Vec<Batch>> {
            let config = of_run(whole, &[])?;
            config.world.install(&mut |_: &str| {})?;
            Inspection::batches(&config, BATCHES)
        };
        let batches = [played(false)?, played(true)?];
        let mut updates = Vec::new();
        for (_, whole, equal_states) in CASES {
            let set = format!("learner.equal_states={equal_states}");
            let config = LearnerConfig::from_toml(&of_run(whole, &[&set])?.to_toml())?;
            let mut learner = Learner::new(config, &compute)?;
            let batches = &batches[usize::from(whole)];
            updates.push(move |call: usize| learner.update(&batches[call % BATCHES]).map(drop));
        }
        let mut works: Vec<&mut dyn FnMut(usize) -> Result<(), LearnerError>> = Vec::new();
        for update in &mut updates {
            works.push(update);
        }
        let rates = effort.rates_in_turn(&mut works)?;
        for ((name, ..), rate) in CASES.into_iter().zip(rates) {
            let name = named(format!("{world}: {name}"), precision);
            figures.push(Measurement::found(name, rate, "updates/s"));
        }
    }
    Ok(figures)
}
