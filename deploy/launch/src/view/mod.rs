//! Observes a run: one poller asks its processes, and their answers are shown as live lines, as a page, as JSON and to Prometheus.

mod advice;
mod export;
mod live;
mod page;
mod poll;

pub(crate) use self::{
    advice::{needed, recovery},
    export::{PrometheusFile, json},
    live::Display,
    page::page,
};
pub use self::{
    live::{TEMPLATE, loss_title},
    poll::{Poller, Reached},
};
