//! The table of properties: each routine with its range, its promises and its check, in the order of the page.
//! A bound is a constant of the routine wherever it has one.

use driml_actor::Schedule;
use driml_learner::{
    affinity::exact,
    augment::{COLOUR_ERROR, CROP_ERROR},
    importance::WEIGHT_ERROR,
    losses::{c51 as c51_loss, info_nce::LOSS_ERROR, projection::MASS_ERROR, scores::CLIP_ERROR},
    optimiser::{
        adam::{STEP_ERROR, moment_error},
        gradients::NORM_ERROR,
    },
};
use driml_model::{EXPECTED_RETURN_ERROR, Precision, StoredAs};
use driml_replay_server::{CHANCE_ERROR, horizon::nhg::GO_ON_ERROR};

use super::{
    checks::{
        adam::{self, PRESET},
        affinity, augment, c51, counters, info_nce, optimiser, products, refused, replay, sampling,
        stored, update, values, worlds,
    },
    property::Property,
};
use crate::studies::random_walk::chain::{GAP_ERROR, LAW_ERROR, MUTUAL_INFORMATION_ERROR};

/// Half of the last place of an f32 near 1, of which the sum of a row of an affinity may be off by four.
const ROW_SUM_ERROR: f64 = 2.5e-7;
/// Deviations of a chi-square that one right law in two million passes.
const DEVIATIONS: f64 = 5.0;
/// How far two ways of computing may be apart, each of which is right to half of it.
const UPDATES_APART: f64 = 2e-4;
/// How far an entry of an affinity may be from 1 / actions where no pair says anything: a quarter of an f32's last place at 1, as 1 /
/// 15 has.
const UNIFORM_ERROR: f64 = 3e-8;
const F32_STEP: f64 = f32::EPSILON as f64;

/// What the errors of the moments allow; the root halves the share that the second is off by.
const MOMENTS_ERROR: f64 = moment_error(PRESET.beta1) + moment_error(PRESET.beta2) / 2.0;

/// Beside half of a parameter's last place a step, its way is the sum of its steps' sizes.
const ADAM: &str = "gradients within 1e15; lr 1e-30 to 1e38, beta 0 to 0.99999, eps 1e-15 to 1e30";
const PRODUCT: &str = "a sum of products, as a share of the precision's `product_error` and floor";
const SPOILT: &str = "cases that hide it, or change other rows or later calls";
const NEAREST: &str = "weights not read as the nearest, ties to even, with their sign";
const OF_WEIGHT: &str = "a weight, as a share of it";

/// Each routine's promises: the error of what, and the largest allowed. A share of what is below 1.2e-38 is one of that.
pub(super) const TABLE: [Property; 32] = [
    Property {
        routine: "C51 projection",
        range: "rewards any, infinite ones included; discounts 0 to 1; a support within 1e30",
        promises: &[
            // Of 1e-7 + 1e-15 N max|v| / width; none is negative.
            ("a probability, as a share of `entry_error`", 1.0),
            ("what a row sums to, before and after", MASS_ERROR),
            ("rows that hide it, or change others' bits", 0.0),
        ],
        check: c51::projection,
    },
    Property {
        routine: "softmax",
        range: "logits finite",
        promises: &[("a probability, as a share of it", c51_loss::ENTRY_ERROR)],
        check: c51::softmax,
    },
    Property {
        routine: "C51 loss (KL)",
        range: "logits finite; targets sum to 1",
        promises: &[
            // Of 10 + sum of target (max logit - logit).
            ("the loss, as a share of its terms", c51_loss::KL_ERROR),
            ("a slope, as a share of 6.1e-8 of it + 1e-15", 1.0),
            ("cases in which the loss is finite all the same", 0.0),
        ],
        check: c51::kl,
    },
    Property {
        routine: "Q-value",
        range: "the expected return; logits finite, or some of them -inf; a support within 1e30",
        promises: &[
            // Beside the value's own last place; never beyond the support.
            ("a value, as a share of the width", EXPECTED_RETURN_ERROR),
        ],
        check: values::expected,
    },
    Property {
        routine: "greedy action",
        range: "weights finite; 1 to 255 actions",
        promises: &[
            // Whose f32 may be the same.
            ("how far its value is below the largest", F32_STEP),
            ("actions of which a lower one has the same logits", 0.0),
            ("rows beyond the finite numbers not refused by number", 0.0),
        ],
        check: values::greedy,
    },
    Property {
        routine: "soft clip",
        range: "dot products finite; bounds 1e-30 to 1e30",
        promises: &[
            ("a score, as a share of it", CLIP_ERROR),
            ("its slope, as a share of `slope_error` times it", 1.0),
        ],
        check: info_nce::clip,
    },
    Property {
        routine: "InfoNCE",
        range: "dot products finite; bounds 1e-30 to 1e30; any rows valid",
        promises: &[
            ("the loss, as a share of 10 + the largest score", LOSS_ERROR),
            // Of 1e-7 of it + 1e-15 + what the rounding of the largest score leaves open.
            ("a slope, as a share of `slope_error`", 1.0),
            ("cases with other bits, or that hide it", 0.0),
        ],
        check: info_nce::loss,
    },
    Property {
        routine: "gradient norm",
        range: "gradients finite",
        promises: &[
            ("the norm, as a share of it", NORM_ERROR),
            ("cases not refused by the parameter's name", 0.0),
        ],
        check: optimiser::norm,
    },
    Property {
        routine: "clipping",
        range: "max_grad_norm 1e-6 to 1e15; norms up to 8e37 times it",
        promises: &[("share by which a norm is above the limit", 6.1e-8)],
        check: optimiser::clipping,
    },
    Property {
        routine: "Adam",
        range: ADAM,
        promises: &[
            // Where f32 holds second moments, and where they are near the least that it holds.
            ("a parameter, as a share of its way", STEP_ERROR / 10.0),
            ("the same at the least second moments", STEP_ERROR),
        ],
        check: adam::sequences,
    },
    Property {
        routine: "Adam",
        range: ADAM,
        promises: &[
            ("a parameter, as a share of its way", MOMENTS_ERROR),
            // Where half of its last place is below 0.4% of a step.
            ("a parameter, all in", 2.0 * STEP_ERROR),
            // Of the decayed mean of sizes, while gradients last.
            ("the first moment", moment_error(PRESET.beta1)),
            ("the second moment", moment_error(PRESET.beta2)),
        ],
        check: adam::long_run,
    },
    Property {
        routine: "Adam",
        range: ADAM,
        promises: &[
            ("a parameter, as a share of its way", F32_STEP),
            ("moments that are not 0, parameters of other bits", 0.0),
        ],
        check: adam::states,
    },
    Property {
        routine: "target network",
        range: "tau 1e-5 to 1; parameters within 1.7e38",
        promises: &[
            // Of the largest that either ever was.
            ("a parameter, as a share of `follow_error`", 1.0),
            ("copies of other bits", 0.0),
        ],
        check: optimiser::target,
    },
    Property {
        routine: "products, f32",
        range: "operands finite, the sum of their products' sizes below 3.4e38",
        promises: &[(PRODUCT, 1.0), (SPOILT, 0.0)],
        check: |cases| products::check(cases, Precision::F32),
    },
    Property {
        routine: "products, bf16",
        range: "operands within 3.38e38, the sum of their products' sizes below 3.3e38",
        promises: &[(PRODUCT, 1.0), (SPOILT, 0.0)],
        check: |cases| products::check(cases, Precision::Bf16),
    },
    Property {
        routine: "whole update",
        range: "f32; weights, returns and supports of any size whose losses are finite",
        promises: &[
            ("the loss, as a share of 1 + loss", UPDATES_APART),
            ("gradients, as a share of their norm, median", UPDATES_APART),
        ],
        check: update::check,
    },
    Property {
        routine: "augmentation",
        range: "crops of a pixel and more; brightness, contrast and saturation 0 to 2, hue -0.5 to 0.5 turns",
        promises: &[
            ("a byte of a crop", CROP_ERROR),
            ("a recoloured byte", COLOUR_ERROR),
        ],
        check: augment::check,
    },
    Property {
        routine: "f32 weights",
        range: "as published (learner.publish_as); finite",
        promises: &[(NEAREST, 0.0), (OF_WEIGHT, StoredAs::F32.error())],
        check: |cases| stored::check(cases, StoredAs::F32),
    },
    Property {
        routine: "f16 weights",
        range: "as published (learner.publish_as); within 65,504",
        promises: &[(NEAREST, 0.0), (OF_WEIGHT, StoredAs::F16.error())],
        check: |cases| stored::check(cases, StoredAs::F16),
    },
    Property {
        routine: "bf16 weights",
        range: "as published (learner.publish_as); within 3.3895e38",
        promises: &[(NEAREST, 0.0), (OF_WEIGHT, StoredAs::Bf16.error())],
        check: |cases| stored::check(cases, StoredAs::Bf16),
    },
    Property {
        routine: "affinity, exact",
        range: "counts below 1e300; decay above 0 and at most 1; smoothing 1e-100 to 1e100",
        promises: &[
            ("an entry, as a share of it", exact::ENTRY_ERROR),
            ("a row's sum, beside 1", ROW_SUM_ERROR),
        ],
        check: affinity::exact,
    },
    Property {
        routine: "affinity, learned",
        range: "any pairs of 1 to 255 actions",
        promises: &[
            ("a row's sum, beside 1, at any update", ROW_SUM_ERROR),
            // One pair says nothing of how actions follow each other.
            ("an entry, beside 1 / actions", UNIFORM_ERROR),
        ],
        check: affinity::learned,
    },
    Property {
        routine: "k by NHG",
        range: "A 0 to 1; k_max 1 to 1,000",
        promises: &[
            ("the probability of a step, beside A", GO_ON_ERROR),
            ("chi-square of k, in deviations", DEVIATIONS),
        ],
        check: sampling::horizon,
    },
    Property {
        routine: "prioritised draw",
        range: "priorities, which are C51 losses, 0 to 3.4e38; alpha 0 to 1",
        promises: &[
            ("a row's chance, as a share of it", CHANCE_ERROR),
            ("chi-square of the draws, in deviations", DEVIATIONS),
        ],
        check: sampling::prioritised,
    },
    Property {
        routine: "importance weight",
        range: "chances 1.2e-38 to 1; beta 0 to 1",
        promises: &[
            // The least likely row's is 1.
            ("a weight, as a share of it", WEIGHT_ERROR),
        ],
        check: sampling::weights,
    },
    Property {
        routine: "n-step return",
        range: "rewards within 3.4e38 / n; n 1 to 1,000; gamma 0 to 1",
        promises: &[
            // Of 6.1e-8 of it + 2.2e-16 n of the terms' sizes; never infinite.
            ("return or discount, as a share of its bound", 1.0),
        ],
        check: replay::returns,
    },
    Property {
        routine: "replay",
        range: "capacities from n_step + frame_stack on; n_step 1 to 1,000",
        promises: &[
            ("capacities too small not refused by name, or others", 0.0),
            ("batches too early, or with other frames or returns", 0.0),
        ],
        check: replay::capacity,
    },
    Property {
        routine: "epsilon",
        range: "any counts of frames; start and end 0 to 1",
        promises: &[("epsilon; never back or beyond its ends", Schedule::ERROR)],
        check: counters::epsilon,
    },
    Property {
        routine: "counters",
        range: "up to 2^53 rows and transitions; others up to 2^64",
        promises: &[("cases whose counts are not those of integers", 0.0)],
        check: counters::counters,
    },
    Property {
        routine: "random walk",
        range: "closed forms; alpha 0 to 1; 2 to 1e6 states, for the gap to 1e8",
        promises: &[
            ("a state's probability", LAW_ERROR),
            ("mutual information, nats", MUTUAL_INFORMATION_ERROR),
            ("spectral gap, as a share of it", GAP_ERROR),
        ],
        check: worlds::walk,
    },
    Property {
        routine: "Ising lattice",
        range: "temperatures above 0 and up to 5; sides up to 4,096",
        promises: &[
            ("chi-square of the energy, in deviations", DEVIATIONS),
            ("sweeps in which the energy rises", 0.0),
            ("sweeps whose books are not those of the spins", 0.0),
        ],
        check: worlds::ising,
    },
    Property {
        routine: "values out of range",
        range: "every setting and every number that a part receives",
        promises: &[("values not refused by name", 0.0)],
        check: refused::check,
    },
];
