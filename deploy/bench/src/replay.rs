//! Measures transitions into a replay server and batches out of it: over each wire, kept on disk, and without a wire.
//! Disk writes that are still pending at the end of the bench are not measured.

use std::{
    fs,
    path::Path,
    time::{Duration, Instant},
};

use anyhow::Context;
use driml_launch::{managed_process::ManagedProcess, output};
use driml_machine::error::usage;
use driml_protocol::tls::{Credentials, Role};

use crate::{
    flags::BenchReplayArgs,
    in_process,
    recording::{CHUNKS, Recording},
    report::Bench,
    server::{REPLAY_DIR, Server, TLS_DIR, Wire},
};

const ROUNDS_ON_DISK: u32 = 3;

/// Measures what the flags select: batches per second without a wire; or transitions and batches per second over wires, or on disk and in
/// memory. Figures are medians of the rounds.
pub(super) fn measure(args: &BenchReplayArgs, bench: &mut Bench<'_>) -> anyhow::Result<()> {
    if args.sampling {
        return in_process::time_sampling(args.held, bench);
    }
    let dir = args.replay_dir.as_deref();
    dir.map_or(Ok(()), |it| output::check_folder("--replay-dir", it))?;
    if let Some(dir) = &args.tls_dir {
        Credentials::read(dir, Role::ReplayServer).map_err(|e| usage!("{e}"))?;
    }
    let recording = Recording::record()?;
    let folder = output::temporary_folder()?;
    let socket = format!("unixsock-stream/{}/s", folder.path().display());
    let wire = |name, endpoint: &str| Wire {
        name,
        endpoint: endpoint.to_owned(),
        shared_memory: endpoint == socket && name != "unix socket",
        capacity: args.held,
        folder: None,
    };
    let tcp = wire("tcp", &format!("tcp/{}", free_port()?));
    // This folder is emptied before and after.
    let dir = dir.map(|it| it.join("driml-bench"));
    let wires = match (&dir, &args.tls_dir) {
        (Some(dir), _) => {
            let mut on_disk = wire("on disk", &socket);
            on_disk.folder = Some((REPLAY_DIR, dir.display().to_string()));
            vec![wire("in memory", &socket), on_disk]
        }
        (None, Some(dir)) => {
            let mut quic = wire("quic", &format!("quic/{}", free_port()?));
            quic.folder = Some((TLS_DIR, dir.display().to_string()));
            vec![tcp, quic]
        }
        (None, None) => {
            let sockets = ["shared memory", "unix socket"];
            let [shared_memory, unix_socket] = sockets.map(|name| wire(name, &socket));
            vec![shared_memory, unix_socket, tcp]
        }
    };
    let rounds = dir.as_ref().map_or(1, |_| ROUNDS_ON_DISK);
    for _ in 0..args.rounds.unwrap_or(rounds) {
        for wire in &wires {
            let on_disk = dir.as_deref().filter(|_| wire.name == "on disk");
            on_disk.map_or(Ok(()), remove_folder)?;
            let mut server = Server::start(wire, folder.path())?;
            rates(&mut server, &recording, bench)?;
            match on_disk {
                Some(dir) => restart(server, folder.path(), dir, bench)?,
                None => drop(server.shut_down(ManagedProcess::ask_to_stop)),
            }
            on_disk.map_or(Ok(()), remove_folder)?;
        }
        if dir.is_none() && args.tls_dir.is_none() {
            in_process::time_assembly(&recording, bench)?;
        }
    }
    Ok(())
}

pub(super) fn insert_name(transitions: u32, wire: &str) -> String {
    format!("insert, {transitions} transitions a chunk, {wire}")
}

/// Measures the transitions that a server stores per second and the batches that it serves per second, once its replay is full.
fn rates(server: &mut Server, recording: &Recording, bench: &mut Bench<'_>) -> anyhow::Result<()> {
    let (meter, held) = (bench.meter, server.wire.capacity);
    server.deliver(recording, CHUNKS[3], |sent, _| sent >= held)?;
    for chunk in CHUNKS {
        let rate = server.deliver(recording, chunk, |_, started| meter.is_long_enough(started))?;
        let name = insert_name(chunk.transitions(), server.wire.name);
        bench.figures.record(name, rate, "transitions/s");
    }
    let (rate, wire) = (server.fetch(&meter)?, server.wire.name);
    let name = format!("batch of 3 states, {wire}");
    bench.figures.record(name, rate, "batches/s");
    Ok(())
}

/// Kills a server and measures how long the next one takes until it has read the log in `dir` back and answers.
fn restart(server: Server, logs: &Path, dir: &Path, bench: &mut Bench<'_>) -> anyhow::Result<()> {
    let mut bytes = 0;
    for entry in fs::read_dir(dir).with_context(|| format!("reading {}", dir.display()))? {
        bytes += entry?.metadata()?.len();
    }
    let megabytes = bytes as f64 / 1e6;
    let wire = server.shut_down(ManagedProcess::kill);
    let started = Instant::now();
    let server = Server::start(&wire, logs)?;
    let took = started.elapsed().max(Duration::from_millis(1));
    let seconds = took.as_secs_f64();
    server.shut_down(ManagedProcess::kill);
    bench.figures.record("log", megabytes, "MB");
    bench.figures.record("restart", seconds, "s");
    let rate = megabytes / seconds;
    bench.figures.record("restart, rate", rate, "MB/s");
    Ok(())
}

fn remove_folder(dir: &Path) -> anyhow::Result<()> {
    if dir.exists() {
        fs::remove_dir_all(dir).with_context(|| format!("emptying {}", dir.display()))?;
    }
    Ok(())
}

/// Returns a free port at the loopback address. The system chooses the port, which is released at once.
fn free_port() -> std::io::Result<std::net::SocketAddr> {
    std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()
}
