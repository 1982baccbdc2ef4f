//! Where the processes of the run in a folder can be asked, or what the folder says of a run that is over.

use driml_protocol::reach;

use crate::{
    chosen::config_of,
    resume,
    run_folder::{Progress, RunFolder, Summary, progress},
};

/// Whether the run in a folder can be asked.
pub enum Live {
    /// The endpoints of its replay servers.
    At(Vec<String>),
    /// No process can be asked: how it ended and how to resume it, for a person.
    Over(String),
}

/// Looks into the folder of a run.
///
/// # Errors
/// It is not a run's, or one whose processes were started by hand.
pub fn endpoints_of(folder: &RunFolder) -> anyhow::Result<Live> {
    let config = config_of(folder)?;
    let endpoints = std::fs::read_to_string(folder.endpoints()).ok();
    // A launcher that runs there holds the lock.
    if folder.lock().is_err()
        && let Some(endpoints) = endpoints
    {
        let endpoints: Vec<_> = endpoints.lines().map(str::to_owned).collect();
        if endpoints.iter().any(|it| reach::look(it).is_ok()) {
            return Ok(Live::At(endpoints));
        }
        let frames = progress(folder).map_or(0, |it| it.frames);
        let how = match frames >= config.frames() {
            true => "is stopping: all frames are stored and its replay server has exited",
            false => "is starting or stopping: no replay server listens",
        };
        let folder = folder.display();
        return Ok(Live::Over(format!(
            "the run in {folder} {how}. Its launcher still runs; retry in a moment\n"
        )));
    }
    if Summary::is_finished(folder) {
        let summary = Summary::read(folder)?.describe(folder);
        return Ok(Live::Over(format!("the run is over\n{summary}")));
    }
    let counts = |it: Progress| format!("{} frames and {} episodes", it.frames, it.episodes);
    let so_far = progress(folder).map_or("nothing".into(), counts);
    let next = match resume::is_resumable(&config.world, folder) {
        true => format!("`driml train --resume {}` resumes it", folder.display()),
        false => "it has no checkpoint to resume from".into(),
    };
    Ok(Live::Over(format!(
        "no process runs in {}, which holds {so_far}: {next}. A run whose processes were started by hand is asked with --connect ENDPOINT\n",
        folder.display()
    )))
}
