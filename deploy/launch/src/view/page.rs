//! A run as a page of text, at most 80 columns wide: `driml status`.

use driml_machine::units::{count, rough_duration};
use driml_protocol::{LogStatus, ProcessStatus, Waiting, Warning};

use super::{
    advice::{actions_needed, format_s, limiter_waits},
    live::progress_text,
};
use crate::{
    console::{align_columns, wrap_to},
    run_view::{RunView, ServerAnswer},
};

/// Actors with a separate line; further actors are only counted.
const ACTORS_MAX: usize = 64;

/// From this age on, in seconds, the page shows how old a process's own report is.
const REPORT_AGE_MAX: f64 = 10.0;

const NAME_CHARS_MAX: usize = 21;
/// The blanks before the rest of a line that is broken.
const INDENT: usize = 4;

/// Writes the page in lines of at most `width` characters, except for a path or a command that is longer.
pub(crate) fn status_page(view: &RunView, width: usize) -> String {
    let (replay, plan) = (&view.replay, &view.plan);
    let is_known = view.servers_answered() || view.servers_ended();
    let frames = is_known.then_some(replay.transitions_inserted);
    let updates = view.learner_status().map(|it| it.updates);
    let updates = updates.or(replay.learner_finished.then_some(replay.updates));
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
        ("chunk retries", replay.chunks_retried),
        ("batch retries", replay.batches_retried),
        ("messages rejected", replay.messages_refused),
    ];
    page += &counts.map(|(what, n)| format!("{what} {n}")).join("  ");
    page = wrap_to(&page, "  ", 0, width);
    let mut waits = limiter_waits(view);
    if waits.is_empty() {
        waits.push(Waiting::Neither.to_string());
    }
    page += &format!("\n{}\n\n", waits.join("; "));

    let head = "process,state,last seen,held,weights,joins,activity";
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
        _ if view.is_finished() => "the run is over: all updates are made and saved\n",
        _ if view.is_over() => "the run is over: all frames were stored and sampled\n",
        _ if view.recovering().next().is_some() => {
            "recovering: the run continues once its replay is read back from disk\n"
        }
        true => "nothing is missing\n",
        false => "",
    };
    for needed in &needed {
        page += &format!("to do: {needed}\n");
    }
    page.lines().map(|line| fit(line, width)).collect()
}

/// Breaks a line at blanks. A command in backticks stays whole, so that it can be pasted.
fn fit(line: &str, width: usize) -> String {
    let parts = line.split('`').enumerate();
    let parts = parts.map(|(at, part)| match at % 2 {
        0 => part.to_owned(),
        _ => part.replace(' ', "\u{a0}"),
    });
    let line = parts.collect::<Vec<_>>().join("`");
    wrap_to(&line, " ", INDENT, width).replace('\u{a0}', " ") + "\n"
}

/// The end of a long name, which tells the servers of a run apart.
fn cut_name(name: &str) -> String {
    match name.chars().count().saturating_sub(NAME_CHARS_MAX) {
        0 => name.to_owned(),
        excess => "…".chars().chain(name.chars().skip(excess + 1)).collect(),
    }
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
                "{bytes} bytes about joined processes and sampled batches are lost, but no transition"
            ),
        };
        line += &format!(
            "; WRITES FAIL for {since} ({why}): no chunk is stored and no batch is served. If the replay server dies now, {lost}"
        );
    }
    line
}

fn server_row(server: &ServerAnswer, server_count: usize) -> Vec<String> {
    let name = match server_count {
        1 => "replay-server".to_owned(),
        _ => cut_name(&server.endpoint),
    };
    let without_status = |state: &str, activity: &str| {
        let cells = [&*name, state, "", "", "", "", activity];
        cells.map(str::to_owned).to_vec()
    };
    if let Some(progress) = server.recovering {
        return without_status("recovering", &format!("replay read: {progress}"));
    }
    let Some(status) = &server.processes else {
        let state = match server.is_gone {
            true => "exited",
            false => "no answer",
        };
        return without_status(state, "");
    };
    let weights = status.weights_age_s.map_or(String::new(), |age| {
        format!("; weights {} old", rough_duration(age))
    });
    let activity = format!(
        "queued: {} ({:.1}\u{a0}MiB), {}{weights}",
        count(status.chunks_waiting, "chunk"),
        status.chunk_bytes_waiting as f64 / f64::from(1 << 20),
        count(status.requests_waiting, "request")
    );
    let mut row = without_status(&format!("up {}", rough_duration(status.up_s)), &activity);
    row[4] = status.weights_version.to_string();
    row
}

fn process_row(process: &ProcessStatus, is_over: bool) -> Vec<String> {
    let state = match process.connected {
        true => "up",
        false if is_over => "left",
        false => "DOWN",
    };
    let time = |seconds: Option<f64>| seconds.map_or("-".into(), rough_duration);
    let doing = process.doing.as_ref();
    let doing = doing.map_or("-".into(), |(doing, since, reported)| {
        let since = rough_duration(*since);
        match *reported > REPORT_AGE_MAX {
            true => format!("{doing} ({since}, as of {} ago)", rough_duration(*reported)),
            false => format!("{doing} ({since})"),
        }
    });
    let version = process.weights_version.map(|it| it.to_string());
    vec![
        process.who.to_string(),
        format!("{state} {}", rough_duration(process.since_s)),
        time(process.last_seen_s),
        time(process.held_s),
        version.unwrap_or_else(|| "-".into()),
        process.lives.to_string(),
        doing,
    ]
}

#[cfg(test)]
mod tests {
    use driml_protocol::ReplayStatus;
    use expect_test::expect_file;
    use serde_json::json;

    use super::*;
    use crate::{
        run_view::Plan,
        testing::{make, view},
    };

    /// The page of a run in which all counts, and all times in seconds, are `number`.
    fn page(endpoints: &[&str], doing: &str, number: u32, width: usize) -> String {
        let plan = make(|it: &mut Plan| (it.world, it.agent) = ("chain".into(), "c51".into()));
        let replay = ReplayStatus {
            transitions_inserted: number.into(),
            transitions_lost: number.into(),
            chunks_retried: number.into(),
            batches_retried: number.into(),
            ..ReplayStatus::default()
        };
        let process = |who| {
            json!({
                "who": who, "connected": number < 9, "since_s": number, "lives": number, "last_seen_s": number, "held_s": null,
                "weights_version": number, "doing": [doing, number, number], "last_warning": null
            })
        };
        let processes = [
            json!("Learner"),
            json!({"Actor": 0}),
            json!({"Actor": u32::MAX}),
        ]
        .map(process);
        let status = json!({
            "up_s": number, "waiting": "Neither", "waiting_s": number, "requests_waiting": number, "chunks_waiting": number,
            "chunk_bytes_waiting": number, "weights_version": number, "weights_age_s": number, "log": null,
            "last_warning": {"text": "a chunk was rejected: it was cut off or padded", "age_s": number}, "processes": processes
        });
        let mut view = view(plan, replay.clone(), None);
        let answer = |endpoint: &&str| ServerAnswer {
            endpoint: (*endpoint).into(),
            replay: Some(replay.clone()),
            processes: serde_json::from_value(status.clone()).unwrap(),
            ..ServerAnswer::default()
        };
        view.servers = endpoints.iter().map(answer).collect();
        status_page(&view, width)
    }

    #[test]
    fn a_page_is_as_wide_as_its_terminal() {
        let small = page(&["tcp/host:1"], "plays", 1, 80);
        expect_file!["../../tests/snapshots/page.txt"].assert_eq(&small);
        let endpoint = format!("unixsock-stream//{}/replay-server-0.sock", "x".repeat(60));
        let doing = "waits for the learner's first weights, which another machine is sending to it";
        for width in [72, 80] {
            let wide = page(&[&endpoint, "tcp/10.0.0.1:7447"], doing, u32::MAX, width);
            for line in wide.lines().filter(|line| !line.contains(&endpoint)) {
                assert!(line.chars().count() <= width, "{line}\n{wide}");
            }
            for part in ["\n…replay-server-0.sock  up ", "\nactor-4294967295  "] {
                assert!(wide.contains(part), "{wide}");
            }
        }
    }
}
