//! The arithmetic of one update, part by part.
//! It counts what is asked for; rows of a batch that need less are not known before it is drawn.

use driml_learner::cost::{UpdateCost, UpdateShape};
use driml_settings::config::RunConfig;

use super::{everything::Everything, line::Line};

/// Arithmetic of one update.
pub(super) fn update_flops(config: &RunConfig, every: &Everything) -> Vec<Line> {
    let positives = config.run.horizon.positives();
    let shape = UpdateShape::of(&config.learner, positives);
    let is = UpdateCost::of(&config.model, &shape);
    let all = UpdateCost::of(&every.model, &every.shape);
    let objective = config.learner.update.objective.name();
    let states = match (positives, config.learner.augment.is_some()) {
        (0, false) => format!("none: {objective} looks at s_t alone"),
        (0, true) => "s_t augmented".into(),
        (1, false) => "one positive a row (run.horizon)".into(),
        (1, true) => "one positive a row (run.horizon), and s_t augmented".into(),
        (p, false) => format!("{p} positives a row (run.horizon)"),
        (p, true) => format!("{p} positives a row (run.horizon), and s_t augmented"),
    };
    let none = |is: u64, yes: &'static str, no| if is > 0 { yes } else { no };
    let rows = shape.rows;
    vec![
        Line::new(
            "s_t, torso",
            is.online,
            all.online,
            format!(
                "{rows} rows forward and backward; at most, as equal states are computed once where it pays"
            ),
        ),
        Line::new(
            "s_t, C51 head",
            is.head,
            all.head,
            "of the action taken alone: its loss reads no other",
        ),
        Line::new(
            "s_{t+n}, target network",
            is.target,
            all.target,
            "forward: what is bootstrapped; at most, as rows without a bootstrap are left out, and equal states but one",
        ),
        Line::new(
            "s_{t+n}, online network",
            is.double_dqn,
            all.double_dqn,
            none(
                is.double_dqn,
                "double_dqn = true",
                "not done: double_dqn = false",
            ),
        ),
        Line::new("more states, torso", is.states, all.states, states),
        Line::new(
            "states, key encoder",
            is.keys,
            all.keys,
            none(is.keys, "forward", "not done: there is no key encoder"),
        ),
        Line::new(
            "psi and phi",
            is.heads,
            all.heads,
            none(is.heads, "forward and backward", "not done: there are none"),
        ),
        Line::new(
            "scores",
            is.scores,
            all.scores,
            none(
                is.scores,
                "each row with each, and their gradients",
                "not done: nothing is compared",
            ),
        ),
    ]
}
