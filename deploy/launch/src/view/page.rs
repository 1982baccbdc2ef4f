//! A run as a page of text: `driml status` and `driml watch --once`.

use driml_protocol::{LogStatus, ProcessStatus, Waiting, Warning};

use super::{
    advice::{actions_needed, format_s, limiter_waits},
    live::progress_text,
};
use crate::{
    console::align_columns,
    run_view::{RunView, ServerAnswer},
};

/// Actors with a separate line; further actors are only counted.
const ACTORS_MAX: usize = 64;

/// From this age on, in seconds, the page shows how old a process's own report is.
const REPORT_AGE_MAX: f64 = 10.0;

pub(crate) fn status_page(view: &RunView) -> String {
    let (replay, plan) = (&view.replay, &view.plan);
    let is_known = view.servers_answered() || view.servers_ended();
    let frames = is_known.then_some(replay.transitions_inserted);
    let updates = view.learner_status().map(|it| it.updates);
    let mut page = format!(
        "{}, {}: {} of {}\n",
        plan.world,
        plan.agent,
        progress_text(view, frames, updates),
        plan.replay_ratio_planned
    );
    let counts = [
        ("lost", replay.transitions_lost),
        ("stored twice", replay.transitions_duplicated),
        ("chunks sent again", replay.chunks_retried),
        ("batches asked again", replay.batches_retried),
        ("messages refused", replay.messages_refused),
    ];
    page += &counts.map(|(what, n)| format!("{what} {n}")).join("  ");
    let mut waits = limiter_waits(view);
    if waits.is_empty() {
        waits.push(Waiting::Neither.to_string());
    }
    page += &format!("\n{}\n\n", waits.join("; "));

    let head = "process,state,activity,last seen,held,weights,lives";
    let mut rows = vec![head.split(',').map(str::to_owned).collect()];
    let mut notes = Vec::new();
    for server in &view.servers {
        rows.push(server_row(server, view.servers.len()));
        let Some(status) = &server.processes else {
            continue;
        };
        let log = status.log.as_ref();
        notes.extend(log.map(|log| log_line(server, log, view.servers.len())));
        notes.extend(warning_note("replay-server", status.last_warning.as_ref()));
        for process in status.processes.iter().take(ACTORS_MAX + 1) {
            rows.push(process_row(process, view.is_over()));
            let who = process.who.to_string();
            notes.extend(warning_note(&who, process.last_warning.as_ref()));
        }
        if let more @ 1.. = status.processes.len().saturating_sub(ACTORS_MAX + 1) {
            rows.push(vec![format!("and {more} more actors")]);
        }
    }
    page += &align_columns(&rows, &[]);
    for note in notes {
        page += &format!("\n{note}\n");
    }
    page.push('\n');
    let needed = actions_needed(view);
    page += match needed.is_empty() {
        _ if view.is_finished() => "the run is over: everything is learned and saved\n",
        _ if view.is_over() => "the run is over: all frames were stored and sampled\n",
        true => "nothing is missing\n",
        false => "",
    };
    for needed in &needed {
        page += &format!("to do: {needed}\n");
    }
    page
}

fn warning_note(who: &str, warning: Option<&Warning>) -> Option<String> {
    let warning = warning?;
    let age = format_s(warning.age_s);
    Some(format!("{who} warned {age} ago: {}", warning.text))
}

/// Describes the log of a replay server that keeps its replay on disk.
fn log_line(server: &ServerAnswer, log: &LogStatus, server_count: usize) -> String {
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let name = match server_count {
        1 => "replay on disk".to_owned(),
        _ => format!("{}, replay on disk", server.endpoint),
    };
    let at_most = |max| format!(" of at most {:.1}", mib(max));
    let most = log.bytes_max.map(at_most).unwrap_or_default();
    let bytes = mib(log.bytes);
    let flushed = format_s(log.flushed_s);
    let mut line = format!(
        "{name}: {bytes:.1} MiB{most} in {}, flushed {flushed} ago",
        log.folder
    );
    if let Some((since, why)) = &log.refused {
        let since = format_s(*since);
        let lost = match log.unwritten_bytes {
            0 => "nothing is lost".to_owned(),
            bytes => format!(
                "it forgets who joined or left and what was drawn since, {bytes} bytes, and no transition"
            ),
        };
        line += &format!(
            "; REFUSED for {since} ({why}): nothing is taken or served. If the replay server dies now, {lost}"
        );
    }
    line
}

fn server_row(server: &ServerAnswer, server_count: usize) -> Vec<String> {
    let name = match server_count {
        1 => "replay-server".to_owned(),
        _ => server.endpoint.clone(),
    };
    if let Some(progress) = server.recovering {
        return vec![name, "reads its replay back".into(), progress.to_string()];
    }
    let Some(status) = &server.processes else {
        let state = match server.is_gone {
            true => "has ended",
            false => "does not answer",
        };
        return vec![name, state.into()];
    };
    let does = format!(
        "{} chunks ({:.1} MiB) and {} requests wait",
        status.chunks_waiting,
        status.chunk_bytes_waiting as f64 / f64::from(1 << 20),
        status.requests_waiting
    );
    let weights = status.weights_age_s.map_or("none yet".into(), |age| {
        format!("{}, {} old", status.weights_version, format_s(age))
    });
    let state = format!("up for {}", format_s(status.up_s));
    vec![name, state, does, String::new(), String::new(), weights]
}

fn process_row(process: &ProcessStatus, is_over: bool) -> Vec<String> {
    let state = match process.connected {
        true => format!("there for {}", format_s(process.since_s)),
        false if is_over => format!("left {} ago", format_s(process.since_s)),
        false => format!("GONE for {}", format_s(process.since_s)),
    };
    let ago = |age: Option<f64>| age.map_or("-".into(), |age| format!("{} ago", format_s(age)));
    let doing = process.doing.as_ref();
    let doing = doing.map_or("-".into(), |(doing, since, said)| {
        let since = format_s(*since);
        match *said > REPORT_AGE_MAX {
            true => format!("{doing} ({since}, reported {} ago)", format_s(*said)),
            false => format!("{doing} ({since})"),
        }
    });
    let version = process.weights_version.map(|it| it.to_string());
    vec![
        process.who.to_string(),
        state,
        doing,
        ago(process.last_seen_s),
        process.held_s.map_or("-".into(), format_s),
        version.unwrap_or_else(|| "-".into()),
        process.lives.to_string(),
    ]
}
