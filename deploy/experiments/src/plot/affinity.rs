//! Draws the action affinity A of runs as heat maps, from their newest checkpoints.
//! Nothing is computed: A is the matrix that the learner last sent to the replay server.

use driml_figure::{Figure, Heat, Panel};
use driml_launch::{checkpoint_choice::read_config, run_folder::RunFolder};
use driml_learner::checkpoint;
use driml_machine::{error::usage, units::count};

use super::runs::folder_name;

pub(crate) fn figure(folders: &[RunFolder]) -> anyhow::Result<Figure> {
    let panels = folders.iter().map(|it| heat(it).map(Panel::Heat));
    let panels = panels.collect::<anyhow::Result<Vec<_>>>()?;
    Ok(Figure {
        title: "Action affinity A of the newest checkpoint".into(),
        notes: vec![
            "A[i, j]: how much likelier action j is after action i than overall, as a softmax over j. k grows a step with probability A."
                .into(),
        ],
        columns: panels.len().min(2),
        panel_size: (520.0, 440.0),
        panels,
    })
}

fn heat(folder: &RunFolder) -> anyhow::Result<Heat> {
    let checkpoints = checkpoint::list(&folder.checkpoints())?;
    let name = folder.display();
    let none =
        || usage!("{name} has no checkpoint, from which A is read: choose a run that has one");
    let (updates, path) = checkpoints.last().ok_or_else(none)?;
    let affinity = checkpoint::read_affinity(path)?;
    let none = || usage!("{name} has no affinity: only driml-ada learns one");
    let affinity = affinity.ok_or_else(none)?;
    let side = affinity.num_actions();
    let matrix = affinity.matrix();
    // From 0, so that nearly equal probabilities have nearly the same colour.
    let most = matrix.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
    let values = matrix.into_iter().map(f64::from);
    let updates = count(*updates, "update");
    let title = format!("{}, {updates}", folder_name(folder.path()));
    Ok(Heat {
        names: action_names(folder, side),
        labels: ("next action".into(), "action".into()),
        unit: "A [probability]".into(),
        decimals: Some(2),
        range: (0.0, most.into()),
        ..Heat::new(&title, side, values.collect())
    })
}

/// Returns the names of the actions, or their numbers if the settings cannot be read.
fn action_names(folder: &RunFolder, side: usize) -> Vec<String> {
    let names = read_config(folder).map(|config| config.action_names());
    let names = names.ok().filter(|names| names.len() == side);
    names.unwrap_or_else(|| (0..side).map(|action| action.to_string()).collect())
}
