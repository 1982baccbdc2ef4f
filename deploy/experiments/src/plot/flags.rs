//! The command line of `driml plot`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use driml_machine::whole_number;

pub use super::runs::Over;

/// What `driml plot` takes.
#[derive(Debug, Args)]
pub struct PlotArgs {
    /// Folders of runs; those that differ in their seed alone become one line with a band, and what is no run's folder is left out
    #[arg(value_name = "RUN", required = true)]
    pub(crate) runs: Vec<PathBuf>,
    /// Column of metrics.csv, one chart each; may be given several times. "return", "loss", "k" and "speed" stand for mean_return,
    /// c51_kl, mean_k and frames_per_second [default: these, the auxiliary losses, and more]
    #[arg(long, value_name = "COLUMN")]
    pub(crate) column: Vec<String>,
    /// What the curves are drawn over
    #[arg(long, value_name = "AXIS", value_enum, default_value_t = Over::Frames)]
    pub(crate) x: Over,
    /// Draw the mean over so many frames (or what else --x says) before each point
    #[arg(long, value_name = "N", value_parser = whole_number::within(1..=u64::MAX))]
    pub(crate) smooth: Option<u64>,
    /// What the band over several seeds shows
    #[arg(long, value_enum, default_value_t = Band::Range)]
    pub(crate) band: Band,
    /// One line a run, whatever its settings
    #[arg(long)]
    pub(crate) separate: bool,
    /// Play the runs' worlds at random for so many episodes, and draw the mean return as a line
    #[arg(long, value_name = "EPISODES", num_args = 0..=1, default_missing_value = "100",
          value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub(crate) random: Option<u32>,
    /// The action affinity A of each run's newest checkpoint as a heat map, instead of charts
    #[arg(long, conflicts_with_all = ["column", "x", "smooth", "band", "separate", "random"])]
    pub(crate) affinity: bool,
    /// For a paper: the charts alone, without card, title and notes, and one legend
    #[arg(long)]
    pub(crate) plain: bool,
    /// Picture to write, .svg, .pdf or .png
    #[arg(long, value_name = "FILE", default_value = "plot.svg")]
    pub(crate) out: PathBuf,
}

impl PlotArgs {
    /// A call that names runs and a picture alone.
    pub(crate) const fn overview(runs: Vec<PathBuf>, out: PathBuf) -> Self {
        Self {
            runs,
            column: Vec::new(),
            x: Over::Frames,
            smooth: None,
            band: Band::Range,
            separate: false,
            random: None,
            affinity: false,
            plain: false,
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
    /// 95% interval of the mean (Student's t), wide where there are few seeds
    Ci,
}
