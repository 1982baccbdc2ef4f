//! What travels between the parts and what is kept, in bytes: payloads without their headers of some 60 bytes.
//! The replay may hold frames compressed, and a socket adds its own; neither is counted.

use driml_model::StoredAs;
use driml_protocol::{BatchHeader, Horizon, RunSpec, TRANSITION_BYTES};
use driml_settings::{config::RunConfig, memory::replay_bytes_each};

use super::{everything::Everything, line::Line};

/// Bytes of transitions, batches and broadcasts.
///
/// # Errors
/// The weights' file cannot be laid out.
pub(super) fn bytes(config: &RunConfig, every: &Everything) -> driml_model::Result<Vec<Line>> {
    let run = &config.run;
    let rows = config.learner.batch_size;
    let header = |run: &RunSpec| BatchHeader::of(run, rows).sampled_by(&config.replay.sampling);
    let batch = |run: &RunSpec| header(run).payload_bytes() as u64;
    let scalars = |run: &RunSpec| {
        let without_states = BatchHeader {
            state_bytes: 0,
            stacked: None,
            ..header(run)
        };
        without_states.payload_bytes() as u64
    };
    // Of all states, and of s_t and s_{t+n} alone; of stacks, their frames and what says which are whose.
    let states = |run: &RunSpec| batch(run) - scalars(run);
    let first_states = |run: &RunSpec| {
        states(&RunSpec {
            horizon: Horizon::None,
            ..run.clone()
        })
    };
    let transition = |run: &RunSpec| (run.frame_bytes() + TRANSITION_BYTES) as u64;
    let positives = run.horizon.positives();
    let whole = config.world.frame_shape();
    let size = |height, width, channels| format!("{height}x{width}x{channels}");
    let frame = size(run.frame_height, run.frame_width, run.frame_channels);
    let whole = size(
        whole.height as u32,
        whole.width as u32,
        whole.channels as u32,
    );
    let frame_why = if frame == whole {
        format!("a frame of {frame}")
    } else {
        format!("{frame} of a frame of {whole}: no convolution reads the rest")
    };
    let state_why = match run.frame_stack {
        1 => "one frame each".into(),
        stack => format!("{stack} frames each; one that several states of a row have travels once"),
    };
    let published = config.learner.publish_as;
    let weights = config.weights_bytes()?;
    let every_weights = every.model.weights_bytes(StoredAs::F32)?;
    Ok(vec![
        Line::new(
            "a transition in a chunk",
            transition(run),
            transition(&every.run),
            format!("{frame_why}; action, end and reward"),
        ),
        Line::new(
            "a transition in the replay",
            replay_bytes_each(run),
            replay_bytes_each(&every.run),
            "the same, and its place; stored once, however often it is read",
        ),
        Line::new(
            "a batch",
            batch(run),
            batch(&every.run),
            format!("{rows} rows that have every state; what a row does not have does not travel"),
        ),
        Line::new(
            "  s_t and s_{t+n}",
            first_states(run),
            first_states(&every.run),
            state_why,
        ),
        Line::new(
            "  s_{t+k}",
            states(run) - first_states(run),
            states(&every.run) - first_states(&every.run),
            format!("{positives} a row: what {} is served", config.run.agent),
        ),
        Line::new(
            "  numbers",
            scalars(run),
            scalars(&every.run),
            "returns, discounts, actions, k",
        ),
        Line::new(
            "a broadcast",
            weights as u64,
            every_weights as u64,
            format!("torso and head, as {published:?}: what acts has no other layer",)
                .to_lowercase(),
        ),
    ])
}
