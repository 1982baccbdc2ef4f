//! `driml status`: who takes part in a run, who waits for whom and since when, and what it would take to go on.
//! It asks as any client would and changes nothing.

mod advice;
mod connection;
mod numbers;
mod run_of_folder;
mod snapshot;
mod text;

use std::time::Duration;

use driml_machine::error::Interrupted;

pub(crate) use self::advice::{not_joined, silent_actors};
pub use self::{
    connection::Connection,
    numbers::Numbers,
    run_of_folder::{Live, endpoints_of},
    snapshot::{ServerAnswer, Snapshot},
};
use crate::{console, interrupts::Interrupts, run_folder::RunFolder};

/// How often a run that is watched is asked.
const PERIOD: Duration = Duration::from_secs(2);
/// Between the two questions from which one answer's rates are taken.
const BETWEEN: Duration = Duration::from_secs(1);

/// Asks once, or again and again until it is interrupted, and prints what it is told; gives the last of it. Once nobody can be asked
/// any more, the run's `folder` tells how it ended, if it is known.
///
/// # Errors
/// Nobody there, or not a run of this program; [`Interrupted`] if one answer was asked for and Ctrl-C came first.
pub fn run(
    connection: &mut Connection,
    folder: Option<&RunFolder>,
    watch: bool,
    json: bool,
) -> anyhow::Result<Snapshot> {
    let interrupts = Interrupts::listen(None)?;
    // For the rates: what has happened since.
    connection.ask();
    if interrupts.wait_timeout(BETWEEN) > 0 {
        return Err(Interrupted.into());
    }
    let terminal = console::Pages::on_stdout();
    loop {
        let snapshot = connection.ask();
        if let Some(folder) = folder.filter(|_| snapshot.is_gone() && !json)
            && let Live::Over(how) = endpoints_of(folder)?
        {
            console::print(&how)?;
            return Ok(snapshot);
        }
        let text = match json {
            true => format!("{}\n", serde_json::to_string(&snapshot)?),
            false => text::describe(&snapshot),
        };
        if !watch {
            console::print(&text)?;
            return Ok(snapshot);
        }
        match json {
            true => console::print(&text)?,
            false => terminal.show(&text)?,
        }
        if snapshot.is_over() || interrupts.wait_timeout(PERIOD) > 0 {
            return Ok(snapshot);
        }
    }
}
