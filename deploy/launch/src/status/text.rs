//! A snapshot as a page of text.

use std::fmt::Write;

use driml_protocol::{LogStatus, PartStatus, Waiting};

use crate::live_view::of_planned;

use super::{
    numbers::seconds,
    snapshot::{ServerAnswer, Snapshot},
};

/// Actors that have a line of their own; of the others it is said how many there are.
const ACTORS_MAX: usize = 64;

/// Age of what a part said of itself, from which on it is told.
const SAID_MAX: f64 = 10.0;

/// The page.
pub(super) fn describe(snapshot: &Snapshot) -> String {
    let mut page = String::new();
    let Snapshot {
        world,
        agent,
        replay,
        learner,
        ..
    } = snapshot;
    let (frames_max, updates_max) = (snapshot.frames_planned, snapshot.updates_planned);
    let updates = learner.as_ref().map_or(format!("?/{updates_max}"), |it| {
        of_planned(it.updates, updates_max)
    });
    let ratio = replay
        .replay_ratio()
        .map_or("-".into(), |it| format!("{it:.2}"));
    let frames = match snapshot.is_answered() || snapshot.is_gone() {
        true => of_planned(replay.transitions_inserted, frames_max),
        false => format!("?/{frames_max}"),
    };
    // Writing to a string cannot fail.
    let _ = writeln!(
        page,
        "{world}, {agent}: frames {frames} ({:.0}/s)  updates {updates} ({:.1}/s)  replay ratio {ratio} of {}",
        snapshot.numbers.frames_per_second,
        snapshot.numbers.updates_per_second,
        snapshot.replay_ratio_planned,
    );
    let counts = [
        ("lost", replay.transitions_lost),
        ("stored twice", replay.transitions_duplicated),
        ("chunks sent again", replay.chunks_retried),
        ("batches asked again", replay.batches_retried),
        ("messages refused", replay.messages_refused),
    ];
    let counts: Vec<_> = counts.map(|(what, n)| format!("{what} {n}")).to_vec();
    let _ = writeln!(page, "{}", counts.join("  "));
    let waits = match snapshot.waits.is_empty() {
        true => Waiting::Nobody.to_string(),
        false => snapshot.waits.join("; "),
    };
    let _ = writeln!(page, "{waits}\n");

    let mut rows = vec![
        [
            "part",
            "state",
            "does",
            "last heard",
            "held",
            "weights",
            "lives",
        ]
        .map(str::to_owned),
    ];
    let mut warnings = Vec::new();
    for server in &snapshot.servers {
        rows.push(server_row(server, snapshot.servers.len()));
        let Some(account) = &server.parts else {
            continue;
        };
        if let Some(warning) = &account.last_warning {
            warnings.push(("replay-server".to_owned(), warning.clone()));
        }
        for part in account.parts.iter().take(ACTORS_MAX + 1) {
            rows.push(part_row(part));
            let warning = part.last_warning.clone();
            warnings.extend(warning.map(|warning| (part.who.to_string(), warning)));
        }
        if let more @ 1.. = account.parts.len().saturating_sub(ACTORS_MAX + 1) {
            let more = format!("and {more} more actors");
            rows.push([more.as_str(), "", "", "", "", "", ""].map(str::to_owned));
        }
    }
    table(&mut page, &rows);
    for (server, log) in logs(snapshot) {
        let _ = writeln!(page, "\n{}", log_line(server, log, snapshot.servers.len()));
    }
    for (who, warning) in warnings {
        let age = seconds(warning.age_s);
        let _ = writeln!(page, "\n{who} warned {age} ago: {}", warning.text);
    }
    let _ = writeln!(page);
    if snapshot.numbers.finished {
        let _ = writeln!(page, "the run is over: all is learned and saved");
    } else if snapshot.is_over() {
        let _ = writeln!(page, "the run has ended: all frames were in and sampled");
    } else if snapshot.to_go_on.is_empty() {
        let _ = writeln!(page, "nothing is missing");
    }
    for needed in &snapshot.to_go_on {
        let _ = writeln!(page, "to go on: {needed}");
    }
    page
}

/// Each replay server that keeps its replay on disk, and how its log stands.
fn logs(snapshot: &Snapshot) -> impl Iterator<Item = (&ServerAnswer, &LogStatus)> {
    let servers = snapshot.servers.iter();
    servers.filter_map(|server| Some((server, server.parts.as_ref()?.log.as_ref()?)))
}

fn log_line(server: &ServerAnswer, log: &LogStatus, of: usize) -> String {
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let name = match of {
        1 => "replay on disk".to_owned(),
        _ => format!("{}, replay on disk", server.endpoint),
    };
    let most = log
        .bytes_max
        .map_or(String::new(), |max| format!(" of at most {:.1}", mib(max)));
    let bytes = mib(log.bytes);
    let flushed = seconds(log.flushed_s);
    let mut line = format!(
        "{name}: {bytes:.1} MiB{most} in {}, flushed {flushed} ago",
        log.folder
    );
    if let Some((since, why)) = &log.refused {
        let _ = write!(
            line,
            "; REFUSED for {} ({why}): nothing is taken or served. {}",
            seconds(*since),
            lost_if_it_dies(log)
        );
    }
    line
}

/// What a disk that refuses costs if the process dies before it takes things again.
fn lost_if_it_dies(log: &LogStatus) -> String {
    match log.unwritten_bytes {
        0 => "If the replay server dies now, nothing is lost".into(),
        bytes => format!(
            "If the replay server dies now, it forgets who joined or left and what was drawn since, {bytes} bytes, and no transition"
        ),
    }
}

fn server_row(server: &ServerAnswer, of: usize) -> [String; 7] {
    let name = match of {
        1 => "replay-server".to_owned(),
        _ => server.endpoint.clone(),
    };
    if let Some(progress) = server.recovering {
        let does = progress.to_string();
        return [&*name, "reads its replay back", &does, "", "", "", ""].map(str::to_owned);
    }
    let Some(account) = &server.parts else {
        let state = match server.is_gone {
            true => "has ended",
            false => "does not answer",
        };
        return [&*name, state, "", "", "", "", ""].map(str::to_owned);
    };
    let does = format!(
        "{} chunks ({:.1} MiB) and {} requests wait",
        account.chunks_waiting,
        account.chunk_bytes_waiting as f64 / f64::from(1 << 20),
        account.requests_waiting
    );
    let weights = account.weights_age_s.map_or("none yet".into(), |age| {
        format!("{}, {} old", account.weights_version, seconds(age))
    });
    let state = format!("up for {}", seconds(account.up_s));
    [
        name,
        state,
        does,
        String::new(),
        String::new(),
        weights,
        String::new(),
    ]
}

fn part_row(part: &PartStatus) -> [String; 7] {
    let state = match part.connected {
        true => format!("there for {}", seconds(part.since_s)),
        false => format!("GONE for {}", seconds(part.since_s)),
    };
    let ago = |age: Option<f64>| age.map_or("-".into(), |age| format!("{} ago", seconds(age)));
    let doing = part
        .doing
        .as_ref()
        .map_or("-".into(), |(doing, since, said)| {
            let doing = format!("{doing} since {}", seconds(*since));
            match *said > SAID_MAX {
                true => format!("{doing} (said {} ago)", seconds(*said)),
                false => doing,
            }
        });
    [
        part.who.to_string(),
        state,
        doing,
        ago(part.heard_s),
        part.held_s.map_or("-".into(), seconds),
        part.weights_version.map_or("-".into(), |it| it.to_string()),
        part.lives.to_string(),
    ]
}

/// Rows with columns as wide as their widest cell.
fn table(page: &mut String, rows: &[[String; 7]]) {
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max();
    let widths: [usize; 7] = std::array::from_fn(|column| width(column).unwrap_or(0));
    for row in rows {
        let cells = row.iter().zip(widths);
        let line: Vec<_> = cells
            .map(|(cell, width)| format!("{cell:width$}"))
            .collect();
        let _ = writeln!(page, "{}", line.join("  ").trim_end());
    }
}
