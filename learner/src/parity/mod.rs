//! The parity check: the learner's own update on a case computed elsewhere in float64, compared tensor by tensor.
//! It has no arithmetic of its own beyond the comparison, and does not print.

mod case;
pub mod deviation;
pub mod float64;
mod tolerance;

use std::{
    fmt,
    path::{Path, PathBuf},
};

use candle_core::Tensor;
use driml_model::{Compute, DimHeads, Encoder, ModelConfig, Network, Parameters};
use driml_protocol::NO_ACTION;

use case::Case;
pub use case::ParityError;
use tolerance::Tolerances;

use crate::{
    agent::{Agent, NetworkParameters},
    auxiliary::{
        Objective,
        dim::DIM,
        key_encoder::KeyEncoder,
        loss::{LossInputs, OnlineFeatures, WeightedLoss},
        settings::{AuxiliarySettings, Lambda},
    },
    losses::scores::{Dots, Scores},
    repeats::EqualStates,
};

/// One tensor group's comparison.
#[derive(Clone, Debug, PartialEq)]
pub struct ParityLine {
    /// The group; for groups of several tensors, with the tensor that is nearest to its tolerance.
    pub name: String,
    /// Largest error found among the group's numbers.
    pub error: f64,
    /// Largest error at which the group passes.
    pub tolerance: f64,
}

impl ParityLine {
    /// Whether the error is within the tolerance; NaN is not.
    pub fn ok(&self) -> bool {
        self.error <= self.tolerance
    }
}

/// What came of one case: every group of tensors with its error and its tolerance.
#[derive(Clone, Debug, PartialEq)]
pub struct ParityReport {
    /// The case's file.
    pub file: PathBuf,
    /// One line a tensor group.
    pub lines: Vec<ParityLine>,
}

impl ParityReport {
    /// Whether everything is within tolerance.
    pub fn passed(&self) -> bool {
        self.lines.iter().all(ParityLine::ok)
    }
}

impl fmt::Display for ParityReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.file.display())?;
        for line in &self.lines {
            let verdict = if line.ok() { "ok" } else { "FAILED" };
            let ParityLine {
                name,
                error,
                tolerance,
            } = line;
            writeln!(
                f,
                "  {name:<48} error {error:9.2e}  tolerance {tolerance:9.2e}  {verdict}"
            )?;
        }
        Ok(())
    }
}

/// Runs one update on a case file, computed as `compute` says, and compares every tensor it expects.
///
/// # Errors
/// A file that cannot be read, is not a case, or lacks a tensor. Values out of tolerance are no error: see the report.
pub fn check_file(path: impl AsRef<Path>, compute: &Compute) -> Result<ParityReport, ParityError> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).map_err(|source| ParityError::Read {
        file: path.to_owned(),
        source,
    })?;
    let in_file = |why: ParityError| ParityError::InFile {
        file: path.to_owned(),
        why: Box::new(why),
    };
    let lines = Case::parse(&bytes)
        .and_then(|case| check(&case, compute))
        .map_err(in_file)?;
    Ok(ParityReport {
        file: path.to_owned(),
        lines,
    })
}

fn check(case: &Case, compute: &Compute) -> Result<Vec<ParityLine>, ParityError> {
    let (mut agent, model) = agent_of(case, compute)?;

    let allowed = Tolerances::of(compute.kernels);
    let mut lines = Vec::new();
    let forward = forward_losses(case, compute)?;
    let evaluation = agent.evaluate_with(&case.batch(), &case.noise(&model)?)?;

    let width = f64::from(model.v_max - model.v_min);
    let (rows, num_actions, atoms) = (case.rows, model.num_actions, model.atoms);
    let expected = case.expected("q_values_t", &[rows, num_actions])?;
    lines.push(line(
        "q_values_t",
        largest(&widened(&agent.q_values_t(&case.batch())?), &expected),
        allowed.q_values * width,
    ));
    let expected = case.expected("next_action", &[rows])?;
    let chosen: Vec<f64> = evaluation
        .next_greedy_action
        .iter()
        .map(|&action| f64::from(action))
        .collect();
    // Of a row that does not bootstrap no action is chosen.
    let agree = |(&got, &wanted): (&f64, &f64)| got == f64::from(NO_ACTION) || got == wanted;
    let same: Vec<bool> = chosen.iter().zip(&expected).map(agree).collect();
    let others = same.iter().filter(|same| !**same).count();
    lines.push(line(
        "next_action (share of rows)",
        others as f64 / rows as f64,
        allowed.next_action_rows,
    ));
    let expected = case.expected("target_projection", &[rows, atoms])?;
    let error = widened(&evaluation.target_projection)
        .chunks(atoms)
        .zip(expected.chunks(atoms))
        .zip(same)
        .filter(|(_, same)| *same)
        .map(|((got, expected), _)| largest(got, expected))
        .fold(0.0, nan_or_larger);
    lines.push(line("target_projection", error, allowed.projection));

    if !evaluation.row_kls.is_empty() {
        let expected = case.expected("row_kl", &[rows])?;
        let error = largest(&widened(&evaluation.row_kls), &expected);
        let most = expected.iter().copied().fold(0.0, f64::max);
        let tolerance = (allowed.loss * most).max(allowed.least_loss);
        lines.push(line("row_kl", error, tolerance));
    }

    let mut loss_line = |name: &str, got: f32, saturated: bool| -> Result<(), ParityError> {
        let expected = case.expected(name, &[1])?[0];
        let relative = if saturated {
            allowed.saturated_loss
        } else {
            allowed.loss
        };
        let tolerance = (relative * expected.abs()).max(allowed.least_loss);
        lines.push(line(name, (f64::from(got) - expected).abs(), tolerance));
        Ok(())
    };
    loss_line("loss.c51_kl", evaluation.c51_kl, false)?;
    let mut total_saturates = false;
    for alone in forward {
        // A loss of weight 0 is not in the update: its value comes from the forward pass alone.
        let in_update = evaluation.losses.iter().find(|it| it.0 == alone.name);
        let got = in_update.map_or(alone.value, |it| it.1);
        // The cases call every loss after the pair of levels that it compares; one that does not say compares global features.
        let pair = alone.name.split_once('_').map_or("4t4", |it| it.1);
        loss_line(&format!("loss.dim.{pair}"), got, alone.saturates)?;
        total_saturates |= alone.saturates && in_update.is_some();
    }
    loss_line("loss.total", evaluation.total, total_saturates)?;

    let global_norm = case.expected("grad_norm", &[1])?[0];
    let (mut worst, mut angles) = (Worst::default(), Worst::default());
    for (name, tensor) in case.online() {
        let expected = case.expected(&format!("grad.{name}"), tensor.dims())?;
        let got = match evaluation.gradients.get(name) {
            Some(gradient) => values(gradient)?,
            None => vec![0.0; expected.len()],
        };
        let difference = norm(
            got.iter()
                .zip(&expected)
                .map(|(got, expected)| got - expected),
        );
        let own = norm(expected.iter().copied());
        let tolerance = allowed.gradient * own + allowed.gradient_of_global * global_norm;
        worst.add("grad", name, difference, tolerance);
        if let Some(angle) = allowed.angle.filter(|_| own >= 0.1 * global_norm) {
            let dot: f64 = got.iter().zip(&expected).map(|(a, b)| a * b).sum();
            let cosine = dot / (own * norm(got.iter().copied()));
            angles.add("1 - cosine", name, 1.0 - cosine, angle);
        }
    }
    lines.extend(worst.lines);
    lines.extend(angles.lines);
    let updated = allowed.updated + allowed.updated_rates * case.settings.adam.lr;
    let got = agent.apply(&evaluation.gradients)?;
    lines.push(line(
        "grad_norm",
        (got - global_norm).abs(),
        allowed.norm * global_norm,
    ));

    let mut worst = Worst::default();
    for (name, tensor) in case.online() {
        let expected = case.expected(&format!("updated.{name}"), tensor.dims())?;
        // What no lambda uses is not built, so it stays as the file gives it.
        let got = values(
            agent
                .online()
                .get(name)
                .map_or(tensor, |var| var.as_tensor()),
        )?;
        worst.add("updated", name, largest(&got, &expected), updated);
    }
    lines.extend(worst.lines);
    let mut worst = Worst::default();
    for (name, var) in agent.key().iter().flat_map(|key| key.iter()) {
        let expected = case.expected(&format!("updated_key.{name}"), var.dims())?;
        worst.add(
            "updated_key",
            name,
            largest(&values(var)?, &expected),
            updated,
        );
    }
    lines.extend(worst.lines);
    case.check_all_expectations_used()?;
    Ok(lines)
}

/// The agent of a case before its update, and its model.
fn agent_of(case: &Case, compute: &Compute) -> Result<(Agent, ModelConfig), ParityError> {
    let sizes = case.model(DimHeads::NONE);
    let model = case.model(case.settings.dim_heads(sizes.num_actions));
    let slow = model.without_dim();
    let device = &compute.device;
    let parameters = NetworkParameters {
        online: Parameters::from_tensors(&model, case.parameters("online.", &model), device)?,
        target: Parameters::from_tensors(&slow, case.parameters("target.", &slow), device)?,
        key: key_parameters(case, &model, compute)?,
    };
    let agent = Agent::from_parameters(model.clone(), case.settings.clone(), compute, parameters)?;
    Ok((agent, model))
}

/// The parameters of the case's key encoder, if its objective has one.
fn key_parameters(
    case: &Case,
    model: &ModelConfig,
    compute: &Compute,
) -> Result<Option<Parameters>, ParityError> {
    if case.settings.auxiliary()?.key_tau().is_none() {
        return Ok(None);
    }
    let named = case.parameters("key.", model);
    let key = Parameters::part_from_tensors(model, Encoder::has, named, &compute.device)?;
    Ok(Some(key))
}

/// An auxiliary loss by a forward pass alone.
struct Forward {
    name: &'static str,
    value: f32,
    /// Whether a score is past the clip's bound, where its slope is below 0.42.
    saturates: bool,
}

/// The auxiliary losses of all pairs that the case speaks of, forward only and untouched by lambda.
fn forward_losses(case: &Case, compute: &Compute) -> Result<Vec<Forward>, ParityError> {
    let settings = &case.settings;
    let objective = if settings.objective == Objective::NONE {
        Objective::of(&DIM)
    } else {
        settings.objective
    };
    let every = AuxiliarySettings {
        objective: objective.name(),
        lambda: Lambda::EVERY,
        ..settings.auxiliary_settings()
    };
    // An objective that does not take every pair is taken as it is.
    let loss = objective.loss(&every).or_else(|_| settings.auxiliary())?;
    let model = case.model(loss.heads(settings.condition_on_action));
    let (device, kernels) = (&compute.device, compute.kernels);
    let named = case.parameters("online.", &model);
    let parameters = Parameters::from_tensors(&model, named, device)?;
    let online = Network::with_kernels(&model, &parameters, kernels)?;
    let key = match (loss.key_tau(), key_parameters(case, &model, compute)?) {
        (Some(tau), Some(key)) => Some(KeyEncoder::new(&model, tau, kernels, key)?),
        _ => None,
    };
    let batch = case.batch();
    let features = OnlineFeatures::new(&online, &model, &*loss, &batch, EqualStates::Each, device)?;
    let losses = loss.losses(&LossInputs {
        online: &online,
        model: &model,
        batch: &batch,
        features: &features,
        key: key.as_ref(),
        device,
    })?;
    let saturates = |Dots { dots, rkhs }: &Dots| -> Result<bool, ParityError> {
        let scores = Scores::new(*rkhs, settings.tanh_clip);
        let dots = values(dots)?;
        let largest = dots
            .iter()
            .fold(0.0, |largest: f64, dot| largest.max(dot.abs()));
        Ok(largest * scores.scale > scores.tanh_clip)
    };
    let mut forward = Vec::new();
    for WeightedLoss {
        name, loss, dots, ..
    } in losses
    {
        let mut any = false;
        for dots in &dots {
            any |= saturates(dots)?;
        }
        forward.push(Forward {
            name,
            value: loss.to_scalar()?,
            saturates: any,
        });
    }
    Ok(forward)
}

fn line(name: &str, error: f64, tolerance: f64) -> ParityLine {
    ParityLine {
        name: name.to_owned(),
        error,
        tolerance,
    }
}

/// Lines of parameter groups (`torso`, `head`, `dim.psi3`, ..): of each, the tensor nearest to its tolerance.
#[derive(Default)]
struct Worst {
    lines: Vec<ParityLine>,
    groups: Vec<String>,
}

impl Worst {
    fn add(&mut self, what: &str, name: &str, error: f64, tolerance: f64) {
        let parts = if name.starts_with("dim.") { 2 } else { 1 };
        let group = name.split('.').take(parts).collect::<Vec<_>>().join(".");
        let new = line(&format!("{what}.{name}"), error, tolerance);
        match self.groups.iter().position(|known| *known == group) {
            None => {
                self.groups.push(group);
                self.lines.push(new);
            }
            Some(at) => {
                let old = &self.lines[at];
                // A NaN, once there, stays.
                let nearer = error * old.tolerance > old.error * tolerance;
                if !old.error.is_nan() && (nearer || error.is_nan()) {
                    self.lines[at] = new;
                }
            }
        }
    }
}

fn values(tensor: &Tensor) -> Result<Vec<f64>, ParityError> {
    Ok(tensor
        .to_dtype(candle_core::DType::F64)?
        .flatten_all()?
        .to_vec1()?)
}

fn widened(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&value| f64::from(value)).collect()
}

fn norm(values: impl Iterator<Item = f64>) -> f64 {
    values.map(|value| value * value).sum::<f64>().sqrt()
}

/// Largest absolute difference; NaN if any is.
fn largest(got: &[f64], expected: &[f64]) -> f64 {
    if got.len() != expected.len() {
        return f64::INFINITY;
    }
    let differences = got
        .iter()
        .zip(expected)
        .map(|(got, expected)| (got - expected).abs());
    differences.fold(0.0, nan_or_larger)
}

/// The larger one; NaN if either is.
fn nan_or_larger(largest: f64, d: f64) -> f64 {
    if d.is_nan() || d > largest {
        d
    } else {
        largest
    }
}
