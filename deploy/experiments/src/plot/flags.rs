//! The command line of `driml plot`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use driml_machine::whole_number;

/// What `driml plot` takes.
#[derive(Debug, Default, Args)]
pub struct PlotArgs {
    /// Run folders; runs that differ only in their seed become one line with a band, and other folders are skipped
    #[arg(value_name = "RUN", required = true)]
    pub(crate) runs: Vec<PathBuf>,
    /// Column of metrics.csv to plot [default: the main ones]; may be given several times. "return", "loss", "k" and "speed" stand for
    /// mean_return, c51_kl, mean_k and frames_per_second
    #[arg(long, value_name = "COLUMN")]
    pub(crate) column: Vec<String>,
    /// Horizontal axis
    #[arg(long, value_name = "AXIS", value_enum, default_value_t = XAxis::Frames)]
    pub(crate) x: XAxis,
    /// Average over so many units of --x before each point
    #[arg(long, value_name = "N", value_parser = whole_number::within(1..=u64::MAX))]
    pub(crate) smooth: Option<u64>,
    /// Band over several seeds
    #[arg(long, value_enum, default_value_t = Band::Range)]
    pub(crate) band: Band,
    /// Draw each run as a separate line
    #[arg(long, conflicts_with = "band")]
    pub(crate) separate: bool,
    /// Play so many episodes with a random policy, 100 unless given, and draw the mean return as a line
    #[arg(long, value_name = "EPISODES", num_args = 0..=1, default_missing_value = "100", value_parser = random_episodes)]
    pub(crate) random: Option<u32>,
    /// Plot the action affinity of each run's newest checkpoint as a heat map
    #[arg(long, conflicts_with_all = ["column", "x", "smooth", "band", "separate", "random"])]
    pub(crate) affinity: bool,
    /// For a paper: charts without title and notes, and one legend
    #[arg(long)]
    pub(crate) plain: bool,
    /// Settings that distinguish runs, although they depend on the machine
    #[arg(skip)]
    pub(crate) compared: Vec<String>,
    /// File to write, .svg, .pdf or .png
    #[arg(long, value_name = "FILE", default_value = "plot.svg")]
    pub(crate) out: PathBuf,
}

/// Reads the number of `--random`. Without one, clap takes a run folder that follows for it.
fn random_episodes(text: &str) -> Result<u32, String> {
    let number = text.parse().ok().filter(|it| (1..=1_000_000).contains(it));
    number.ok_or_else(|| {
        "give a number of episodes from 1 to 1000000, such as --random 100 RUN".into()
    })
}

/// What a curve is drawn over: columns that only grow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum XAxis {
    /// Environment steps, over all actors
    #[default]
    Frames,
    /// Updates of the learner
    Updates,
    /// Seconds since the run began
    Seconds,
}

impl XAxis {
    /// Returns the column of `metrics.csv`, which is also the label of the axis.
    pub(super) const fn column(self) -> &'static str {
        match self {
            Self::Frames => "frames",
            Self::Updates => "updates",
            Self::Seconds => "seconds",
        }
    }
}

/// What the band over several seeds shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Band {
    /// From the smallest to the largest value
    #[default]
    Range,
    /// One standard deviation to each side of the mean
    Sd,
    /// 95% interval of the mean (Student's t), wide where there are few seeds
    Ci,
}
