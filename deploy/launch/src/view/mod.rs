//! Observes a run: one poller asks its processes, and their answers are shown as live lines, as a page, as JSON and to Prometheus.

mod advice;
mod export;
mod live;
mod page;
mod poll;

pub(crate) use self::{
    advice::{actions_needed, describe_recovery, missing_shards},
    export::{PrometheusFlag, run_json},
    live::Display,
    page::status_page,
};
pub use self::{
    live::{PROGRESS_TEMPLATE, loss_title},
    poll::{Poller, ServerConnection},
};
