//! The command line of `driml plot`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use driml_machine::whole_number;

/// What `driml plot` takes.
#[derive(Debug, Args)]
pub struct PlotArgs {
    /// Folders of runs; those that differ in their seed alone become one line with a band
    #[arg(value_name = "RUN", required = true)]
    pub(crate) runs: Vec<PathBuf>,
    /// Column of metrics.csv, one chart each; may be given several times [default: return, losses, k, speed]
    #[arg(long, value_name = "COLUMN")]
    pub(crate) column: Vec<String>,
    /// Draw the mean over this many frames before each point
    #[arg(long, value_name = "FRAMES", value_parser = whole_number::within(1..=u64::MAX))]
    pub(crate) smooth: Option<u64>,
    /// What the band over several seeds shows
    #[arg(long, value_enum, default_value_t = Band::Range)]
    pub(crate) band: Band,
    /// One line a run, whatever its settings
    #[arg(long)]
    pub(crate) separate: bool,
    /// The action affinity A of each run's newest checkpoint as a heat map, instead of charts
    #[arg(long, conflicts_with_all = ["column", "smooth", "band", "separate"])]
    pub(crate) affinity: bool,
    /// Picture to write, .svg or .png
    #[arg(long, value_name = "FILE", default_value = "plot.svg")]
    pub(crate) out: PathBuf,
}

impl PlotArgs {
    /// A call that names runs and a picture alone.
    pub(crate) const fn overview(runs: Vec<PathBuf>, out: PathBuf) -> Self {
        Self {
            runs,
            column: Vec::new(),
            smooth: None,
            band: Band::Range,
            separate: false,
            affinity: false,
            out,
        }
    }
}

/// What the band over several seeds shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Band {
    /// From the smallest to the largest value
    Range,
    /// One standard deviation to each side of the mean
    Sd,
}
