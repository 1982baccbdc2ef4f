//! The parity check: runs the learner's update on a case that was computed elsewhere in float64, and compares tensor by tensor.
//! It only compares, and does not print.

mod case;
pub mod deviation;
mod tolerance;

use std::{
    collections::BTreeMap,
    fmt,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result};
use driml_model::{Compute, Encoder, ModelConfig, Parameters};
use driml_protocol::NO_ACTION;

use case::Case;
use tolerance::Tolerances;

use crate::{
    agent::{Agent, NetworkParameters},
    auxiliary::{AuxiliaryKind, dim::DIM, settings::Lambda},
    losses::scores::{DotProducts, ScoreClip},
    losses_and_gradients::{Losses, LossesAndGradients},
    settings::UpdateSettings,
    tensors::to_vec_f64,
};

/// The comparison of one group of tensors.
#[derive(Clone, Debug, PartialEq)]
pub struct ParityLine {
    /// The group's name; for a group of several tensors, the name of the tensor that is nearest to its tolerance.
    pub name: String,
    /// Largest error found among the group's numbers.
    pub error: f64,
    /// Largest error at which the group passes.
    pub tolerance: f64,
}

impl ParityLine {
    /// Whether the error is within the tolerance; NaN is not.
    pub fn passed(&self) -> bool {
        self.error <= self.tolerance
    }
}

/// The result of one case: every group of tensors with its error and its tolerance.
#[derive(Clone, Debug, PartialEq)]
pub struct ParityReport {
    /// The case's file.
    pub file: PathBuf,
    /// One line per group of tensors.
    pub lines: Vec<ParityLine>,
}

impl ParityReport {
    /// Whether everything is within tolerance.
    pub fn passed(&self) -> bool {
        self.lines.iter().all(ParityLine::passed)
    }
}

impl fmt::Display for ParityReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.file.display())?;
        for line in &self.lines {
            let verdict = if line.passed() { "ok" } else { "FAILED" };
            let (error, tolerance) = (line.error, line.tolerance);
            writeln!(
                f,
                "  {:<48} error {error:9.2e}  tolerance {tolerance:9.2e}  {verdict}",
                line.name
            )?;
        }
        Ok(())
    }
}

/// Runs one update on a case file, computed as `compute` says, and compares every tensor that the case expects.
///
/// # Errors
/// A file that cannot be read, is not a case, or lacks a tensor; [`UpdateError`](crate::UpdateError) if the arithmetic of a sound case
/// fails. Values out of tolerance are lines of the report.
pub fn check_file(path: impl AsRef<Path>, compute: &Compute) -> Result<ParityReport> {
    let file = path.as_ref().to_owned();
    let bytes = std::fs::read(&file).with_context(|| format!("cannot read {}", file.display()))?;
    let lines = Case::parse(&bytes).and_then(|case| check(&case, compute));
    let lines = lines.with_context(|| file.display().to_string())?;
    Ok(ParityReport { file, lines })
}

fn check(case: &Case, compute: &Compute) -> Result<Vec<ParityLine>> {
    let mut agent = case_agent(case, case.settings.clone(), compute)?;
    let forward = forward_losses(case, compute)?;
    let computed = agent.gradients_with(&case.inputs.batch(), &case.noise(agent.model())?)?;
    let mut check = CaseCheck {
        case,
        allowed: Tolerances::new(compute.kernels, agent.model().torso),
        lines: Vec::new(),
    };
    check.targets(&agent, &computed)?;
    check.losses(&computed.losses, &forward)?;
    check.gradients(&computed)?;
    let expected = case.expected("grad_norm", &[1])?[0];
    let error = (agent.apply(&computed.gradients)? - expected).abs();
    check.add("grad_norm", error, check.allowed.norm * expected);
    check.updated(&agent)?;
    case.check_all_expectations_used()?;
    Ok(check.lines)
}

struct CaseCheck<'a> {
    case: &'a Case,
    allowed: Tolerances,
    lines: Vec<ParityLine>,
}

impl CaseCheck<'_> {
    fn add(&mut self, name: &str, error: f64, tolerance: f64) {
        self.lines.push(new_line(name, error, tolerance));
    }

    /// Compares values of s_t, greedy actions in s_{t+n} and projected targets.
    fn targets(&mut self, agent: &Agent, computed: &LossesAndGradients) -> Result<()> {
        let (case, allowed, model) = (self.case, self.allowed, agent.model());
        let batch = case.inputs.batch();
        let expected = case.expected("q_values_t", &[batch.rows, model.num_actions])?;
        let error = largest_error(&to_f64(&agent.q_values_t(&batch)?), &expected);
        let width = f64::from(model.v_max - model.v_min);
        self.add("q_values_t", error, allowed.q_values * width);

        let expected = case.expected("next_action", &[batch.rows])?;
        // A row that does not bootstrap has no chosen action.
        let agree = |(&got, wanted): (&u8, &f64)| got == NO_ACTION || f64::from(got) == *wanted;
        let chosen = computed.next_greedy_action.iter().zip(&expected);
        let same: Vec<bool> = chosen.map(agree).collect();
        let others = same.iter().filter(|same| !**same).count();
        let share = others as f64 / batch.rows as f64;
        self.add(
            "next_action (share of rows)",
            share,
            allowed.next_action_rows,
        );

        let expected = case.expected("target_projection", &[batch.rows, model.atoms])?;
        let found = to_f64(&computed.target_projection);
        let rows = found.chunks(model.atoms).zip(expected.chunks(model.atoms));
        let rows = rows.zip(same).filter(|(_, same)| *same);
        let errors = rows.map(|((got, expected), _)| largest_error(got, expected));
        let error = errors.fold(0.0, max_or_nan);
        self.add("target_projection", error, allowed.projection);
        Ok(())
    }

    fn losses(&mut self, found: &Losses, forward: &[ForwardLoss]) -> Result<()> {
        if !found.row_kls.is_empty() {
            let expected = self.case.expected("row_kl", &[found.row_kls.len()])?;
            let error = largest_error(&to_f64(&found.row_kls), &expected);
            let most = expected.iter().copied().fold(0.0, f64::max);
            self.add("row_kl", error, self.allowed.loss_tolerance(most, false));
        }
        self.loss("loss.c51_kl", found.c51_kl, false)?;
        let mut total_saturates = false;
        for loss in forward {
            // A loss of weight 0 is not in the update: its value comes from the forward pass alone.
            let in_update = found.auxiliary.iter().find(|it| it.0 == loss.name);
            let got = in_update.map_or(loss.value, |it| it.1);
            // A case names every loss after its pair of levels. A loss without a pair compares global features.
            let pair = loss.name.split_once('_').map_or("4t4", |it| it.1);
            self.loss(&format!("loss.dim.{pair}"), got, loss.is_saturated)?;
            total_saturates |= loss.is_saturated && in_update.is_some();
        }
        self.loss("loss.total", found.total, total_saturates)
    }

    fn loss(&mut self, name: &str, got: f32, is_saturated: bool) -> Result<()> {
        let expected = self.case.expected(name, &[1])?[0];
        let tolerance = self.allowed.loss_tolerance(expected, is_saturated);
        self.add(name, (f64::from(got) - expected).abs(), tolerance);
        Ok(())
    }

    fn gradients(&mut self, computed: &LossesAndGradients) -> Result<()> {
        let (case, allowed) = (self.case, self.allowed);
        let global_norm = case.expected("grad_norm", &[1])?[0];
        let (mut worst, mut angles) = (WorstByGroup::default(), WorstByGroup::default());
        for (name, tensor) in case.tensors_under("online.") {
            let expected = case.expected(&format!("grad.{name}"), tensor.dims())?;
            let got = match computed.gradients.get(name) {
                Some(gradient) => to_vec_f64(gradient)?,
                None => vec![0.0; expected.len()],
            };
            let difference = norm(got.iter().zip(&expected).map(|(got, wanted)| got - wanted));
            let own_norm = norm(expected.iter().copied());
            let tolerance = allowed.gradient * own_norm + allowed.gradient_of_global * global_norm;
            worst.add("grad", name, difference, tolerance);
            if let Some(angle) = allowed
                .angle
                .filter(|_| own_norm > 0.0 && own_norm >= 0.1 * global_norm)
            {
                let dot: f64 = got.iter().zip(&expected).map(|(a, b)| a * b).sum();
                let cosine = dot / (own_norm * norm(got.iter().copied()));
                angles.add("1 - cosine", name, 1.0 - cosine, angle);
            }
        }
        self.lines.extend(worst.0.into_values());
        self.lines.extend(angles.0.into_values());
        Ok(())
    }

    fn updated(&mut self, agent: &Agent) -> Result<()> {
        let (case, allowed) = (self.case, self.allowed);
        let tolerance = allowed.updated + allowed.updated_rates * case.settings.adam.lr;
        let (mut online, mut keys) = (WorstByGroup::default(), WorstByGroup::default());
        for (name, tensor) in case.tensors_under("online.") {
            let expected = case.expected(&format!("updated.{name}"), tensor.dims())?;
            // Parameters that no lambda uses are not built, so they stay as in the file.
            let var = agent.online().get(name);
            let got = to_vec_f64(var.map_or(tensor, |var| var.as_tensor()))?;
            online.add("updated", name, largest_error(&got, &expected), tolerance);
        }
        for (name, var) in agent.key_encoder().iter().flat_map(|key| key.iter()) {
            let expected = case.expected(&format!("updated_key.{name}"), var.dims())?;
            let error = largest_error(&to_vec_f64(var)?, &expected);
            keys.add("updated_key", name, error, tolerance);
        }
        self.lines.extend(online.0.into_values());
        self.lines.extend(keys.0.into_values());
        Ok(())
    }
}

/// An agent with the parameters of a case before its update.
fn case_agent(case: &Case, settings: UpdateSettings, compute: &Compute) -> Result<Agent> {
    let auxiliary = settings.make_auxiliary_loss()?;
    let model = case.model(auxiliary.heads(settings.condition_on_action));
    let slow = model.without_dim();
    let device = &compute.device;
    let read = |prefix: &str, model: &ModelConfig, part: fn(&str) -> bool| {
        Parameters::from_tensors(model, part, case.parameters(prefix, model), device)
    };
    let key_encoder = auxiliary.key_tau();
    let key_encoder = key_encoder.map(|_| read("key.", &model, Encoder::has_parameter));
    let parameters = NetworkParameters {
        online: read("online.", &model, |_| true)?,
        target: read("target.", &slow, |_| true)?,
        key_encoder: key_encoder.transpose()?,
    };
    let agent = Agent::from_parameters(model, settings, compute, parameters);
    Ok(agent?)
}

/// The value of an auxiliary loss, from a forward pass alone.
struct ForwardLoss {
    name: &'static str,
    value: f32,
    /// Whether a score is beyond the clip's bound, where the clip's derivative is below 0.42.
    is_saturated: bool,
}

/// Computes the auxiliary losses of all pairs that the case contains, by a forward pass alone and whatever lambda is.
fn forward_losses(case: &Case, compute: &Compute) -> Result<Vec<ForwardLoss>> {
    let settings = &case.settings;
    let mut all_pairs = UpdateSettings {
        lambda: Lambda::ONES,
        ..settings.clone()
    };
    if settings.auxiliary_loss == AuxiliaryKind::NONE {
        all_pairs.auxiliary_loss = AuxiliaryKind::from_item(&DIM);
        // Read from the case's parameters: if the update is C51's alone, the settings do not say it.
        let mut parameters = case.tensors_under("online.");
        all_pairs.condition_on_action = parameters.any(|it| it.0.starts_with("dim.action."));
    }
    // A loss that rejects some of the pairs keeps the case's settings.
    if all_pairs.make_auxiliary_loss().is_err() {
        all_pairs = settings.clone();
    }
    let networks = case_agent(case, all_pairs, compute)?.networks;
    let batch = case.inputs.batch();
    let losses = networks.auxiliary_losses(&batch, &networks.online_features(&batch)?)?;
    let is_saturated = |it: &DotProducts| -> Result<bool> {
        let clip = ScoreClip::new(it.width, settings.tanh_clip);
        let mut dots = to_vec_f64(&it.values)?.into_iter();
        Ok(dots.any(|dot| dot.abs() * clip.scale > clip.tanh_clip))
    };
    let mut forward = Vec::new();
    for it in &losses {
        let saturating: Result<Vec<bool>, _> = it.dot_products.iter().map(is_saturated).collect();
        forward.push(ForwardLoss {
            name: it.name,
            value: it.loss.to_scalar()?,
            is_saturated: saturating?.contains(&true),
        });
    }
    Ok(forward)
}

fn new_line(name: &str, error: f64, tolerance: f64) -> ParityLine {
    ParityLine {
        name: name.to_owned(),
        error,
        tolerance,
    }
}

/// One line per group of parameters (`torso`, `head`, `dim.psi3`, ..): the tensor nearest to its tolerance.
#[derive(Default)]
struct WorstByGroup(BTreeMap<String, ParityLine>);

impl WorstByGroup {
    fn add(&mut self, what: &str, name: &str, error: f64, tolerance: f64) {
        let parts = if name.starts_with("dim.") { 2 } else { 1 };
        let group = name.split('.').take(parts).collect::<Vec<_>>().join(".");
        let new = new_line(&format!("{what}.{name}"), error, tolerance);
        let worst = self.0.entry(group).or_insert_with(|| new.clone());
        // An error of NaN is kept.
        let nearer = error * worst.tolerance > worst.error * tolerance;
        if !worst.error.is_nan() && (nearer || error.is_nan()) {
            *worst = new;
        }
    }
}

fn to_f64(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&value| f64::from(value)).collect()
}

fn norm(values: impl Iterator<Item = f64>) -> f64 {
    values.map(|value| value * value).sum::<f64>().sqrt()
}

/// Largest absolute difference; NaN if any is.
fn largest_error(got: &[f64], expected: &[f64]) -> f64 {
    if got.len() != expected.len() {
        return f64::INFINITY;
    }
    let pairs = got.iter().zip(expected);
    pairs
        .map(|(got, expected)| (got - expected).abs())
        .fold(0.0, max_or_nan)
}

/// The larger one; NaN if either is.
fn max_or_nan(largest: f64, d: f64) -> f64 {
    if d.is_nan() || d > largest {
        d
    } else {
        largest
    }
}
