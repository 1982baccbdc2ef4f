//! What it costs to keep a replay on disk: a server that does and one that does not, in turn, and how long it takes to read it back.
//! The clients are those of `replay`; what a disk still has to do when the bench has ended is not seen.

use std::{
    fs::{self, File},
    hint::black_box,
    path::Path,
    time::{Duration, Instant},
};

use anyhow::{Context, bail, ensure};
use driml_protocol::{Batch, BatchRequest, BufferPool, InsertReply, Learned, RequestId};
use nix::fcntl::{PosixFadviseAdvice, posix_fadvise};

use crate::{
    effort::{Effort, median},
    flags::BenchReplayArgs,
    measurements::Measurement,
    recording::Recording,
    replay::{ANSWER_MAX, CHUNKS, Run, Wire, touched},
    taking_part,
};

/// Chunks that are measured: what many actors send, and what one of 16 copies does.
const MEASURED: [(u32, u32); 2] = [CHUNKS[1], CHUNKS[3]];

/// What was measured of one server, in an order of its own; each once a round.
type Figures = Vec<(String, &'static str, Vec<f64>)>;

/// Rates and latencies with the replay in memory and on disk, and how long a restart takes.
///
/// # Errors
/// An engine that cannot be had, a server that does not answer, a folder that cannot be written.
pub(super) fn measure(args: &BenchReplayArgs, dir: &Path) -> anyhow::Result<Vec<Measurement>> {
    let (effort, recording) = (Effort::new(&args.flags), Recording::play()?);
    let folder = tempfile::Builder::new().prefix("driml-").tempdir()?;
    let endpoint = format!("unixsock-stream/{}/s", folder.path().display());
    let wire = Wire {
        endpoint: &endpoint,
        shared_memory: true,
        tls_dir: None,
    };
    let held = format!("replay.capacity_transitions={}", args.held);
    let in_memory = ["--set".to_owned(), held];
    let mut on_disk = in_memory.to_vec();
    on_disk.extend(["--replay-dir".into(), dir.display().to_string()]);
    let mut modes: [(&str, &[String], Figures); 2] = [
        ("in memory", &in_memory, Vec::new()),
        ("on disk", &on_disk, Vec::new()),
    ];
    let mut restarts: Figures = Vec::new();
    for _ in 0..args.rounds {
        for (mode, flags, found) in &mut modes {
            let is_on_disk = *mode == "on disk";
            if is_on_disk && dir.exists() {
                fs::remove_dir_all(dir).with_context(|| format!("emptying {}", dir.display()))?;
            }
            let mut run = Run::start(wire, folder.path(), flags)?;
            of_server(&mut run, &recording, args.held, &effort, found)?;
            if is_on_disk {
                of_restart(run, dir, &mut restarts, || {
                    Run::start(wire, folder.path(), flags)
                })?;
            } else {
                run.end();
            }
        }
    }
    if dir.exists() {
        fs::remove_dir_all(dir).with_context(|| format!("emptying {}", dir.display()))?;
    }
    let mut measurements = Vec::new();
    let [(_, _, memory), (_, _, disk)] = &modes;
    for ((name, unit, memory), (_, _, disk)) in memory.iter().zip(disk) {
        let (memory, disk) = (median(memory), median(disk));
        measurements.push(Measurement::found(
            format!("{name}, in memory"),
            memory,
            unit,
        ));
        measurements.push(Measurement::found(format!("{name}, on disk"), disk, unit));
    }
    for (name, unit, values) in &restarts {
        measurements.push(Measurement::found(name, median(values), unit));
    }
    Ok(measurements)
}

fn note(figures: &mut Figures, name: String, unit: &'static str, value: f64) {
    match figures.iter_mut().find(|(known, ..)| *known == name) {
        Some((.., values)) => values.push(value),
        None => figures.push((name, unit, vec![value])),
    }
}

/// The quantile of some durations, in milliseconds.
fn quantile_ms(seconds: &mut [f64], quantile: f64) -> f64 {
    seconds.sort_by(f64::total_cmp);
    let at = ((seconds.len() - 1) as f64 * quantile).round() as usize;
    seconds[at] * 1e3
}

/// Fills a replay and measures what it does then.
fn of_server(
    run: &mut Run,
    recording: &Recording,
    held: u64,
    effort: &Effort,
    figures: &mut Figures,
) -> anyhow::Result<()> {
    run.deliver(recording, CHUNKS[3], |sent, _| sent >= held)?;
    for chunk in MEASURED {
        let transitions = chunk.0 * chunk.1;
        let rate = run.deliver(recording, chunk, |_, started| effort.is_spent(started))?;
        note(
            figures,
            format!("insert, {transitions} a chunk"),
            "transitions/s",
            rate,
        );
        let mut seconds = insert_one_by_one(run, recording, chunk, effort)?;
        for (name, quantile) in [("p50", 0.5), ("p99", 0.99)] {
            let name = format!("insert alone, {transitions} a chunk, {name}");
            note(figures, name, "ms", quantile_ms(&mut seconds, quantile));
        }
    }
    let mut seconds = ask_one_by_one(run, effort)?;
    for (name, quantile) in [("p50", 0.5), ("p99", 0.99)] {
        let value = quantile_ms(&mut seconds, quantile);
        note(figures, format!("batch alone, {name}"), "ms", value);
    }
    Ok(())
}

/// Seconds from each chunk's sending to its acknowledgement.
fn insert_one_by_one(
    run: &mut Run,
    recording: &Recording,
    chunk: (u32, u32),
    effort: &Effort,
) -> anyhow::Result<Vec<f64>> {
    let (client, actor, pool) = run.next_actor()?;
    let alive = taking_part::join_as_actor(&client, actor)?;
    let (mut seconds, first) = (Vec::new(), Instant::now());
    for chunk in recording.chunks(actor, chunk, pool) {
        let header = chunk.header;
        let sealed = client.seal_with(&header, chunk.into_payload().freeze())?;
        let started = Instant::now();
        let reply = client.send(sealed, ANSWER_MAX)?.wait()?;
        seconds.push(started.elapsed().as_secs_f64());
        ensure!(
            matches!(reply, InsertReply::Stored { .. }),
            "a chunk was not stored: {reply:?}"
        );
        if effort.is_spent(first) {
            break;
        }
    }
    drop(alive);
    Ok(seconds)
}

/// Seconds from each request for a batch to the batch.
fn ask_one_by_one(run: &mut Run, effort: &Effort) -> anyhow::Result<Vec<f64>> {
    let client = run.learner_client()?;
    let _alive = taking_part::join_as_learner(&client)?;
    let (pool, mut id) = (BufferPool::new(2), RequestId::first(1));
    let (mut seconds, first) = (Vec::new(), Instant::now());
    while !effort.is_spent(first) {
        let request = BatchRequest {
            learner: taking_part::LEARNER,
            id,
            rows: run.learner.learner.batch_size,
            shared_memory: true,
            learned: Learned::default(),
            other_shards: None,
        };
        id = id.next();
        let started = Instant::now();
        let asked = client.send(client.seal(&request)?, ANSWER_MAX)?;
        let (reply, payload) = asked.receive(&pool)?;
        seconds.push(started.elapsed().as_secs_f64());
        let Some(header) = reply.header() else {
            bail!("no batch: {reply:?}");
        };
        let batch = Batch::from_payload(header, payload)?;
        let planes = [batch.states_t(), batch.states_k(), batch.states_n()];
        black_box(planes.map(|plane| touched(&plane)));
    }
    Ok(seconds)
}

/// Kills a server twice and measures how long the next one takes until it answers: with the log in the system's memory, and not.
fn of_restart(
    run: Run,
    dir: &Path,
    figures: &mut Figures,
    start: impl Fn() -> anyhow::Result<Run>,
) -> anyhow::Result<()> {
    let bytes = size(dir)?;
    note(figures, "log".into(), "MB", bytes as f64 / 1e6);
    run.kill();
    for (name, is_cold) in [("from memory", false), ("from disk", true)] {
        if is_cold {
            forget(dir)?;
        }
        let started = Instant::now();
        let run = start()?;
        let seconds = started.elapsed();
        note(
            figures,
            format!("restart, {name}"),
            "s",
            seconds.as_secs_f64(),
        );
        note(
            figures,
            format!("restart, {name}, rate"),
            "MB/s",
            bytes as f64 / 1e6 / seconds.max(Duration::from_millis(1)).as_secs_f64(),
        );
        run.kill();
    }
    Ok(())
}

/// Bytes of all files in a folder.
fn size(dir: &Path) -> anyhow::Result<u64> {
    let mut bytes = 0;
    for entry in fs::read_dir(dir).with_context(|| format!("reading {}", dir.display()))? {
        bytes += entry?.metadata()?.len();
    }
    Ok(bytes)
}

/// Lets the system forget what it keeps of the files in a folder in its memory.
fn forget(dir: &Path) -> anyhow::Result<()> {
    for entry in fs::read_dir(dir)? {
        let file = File::open(entry?.path())?;
        file.sync_all()?;
        posix_fadvise(&file, 0, 0, PosixFadviseAdvice::POSIX_FADV_DONTNEED)?;
    }
    Ok(())
}
