//! One system under test: its folder, its mark, and every process that carries the mark.
//! This module starts and finds processes; `process` and `client` read what they output.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::atomic::{AtomicU32, AtomicU64, Ordering},
};

use driml_protocol::{
    Keys, RunClient, RunSpec, fail_point,
    tls::{Credentials, Role},
};
use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};

use crate::{
    certificates::Certificates,
    client::{Client, NAMESPACE, connect, quic_endpoint},
    process::{Exit, Process},
    run_folder::{Outcome, RunFolder, Summary},
    skipped::succeeds,
    waiting::{wait_for, wait_until},
};

/// The environment variable that marks each process of a system. Children inherit it, so the harness also finds those of a killed launcher.
const MARK: &str = "DRIML_TEST_SYSTEM";

/// A folder and the processes started in it. Dropping the system kills every process that is left.
#[derive(Debug)]
pub struct TestSystem {
    program: String,
    folder: tempfile::TempDir,
    mark: String,
    /// The endpoint that connects the processes: by default a unix socket, which needs no free port.
    endpoint: String,
    /// The flag that makes processes use TLS; empty without TLS.
    tls: &'static str,
    /// The number of updates after which newly started learners pause; with [`NEVER`] they do not pause.
    pause_at_updates: AtomicU64,
}

/// More updates than any learner makes.
const NEVER: u64 = u64::MAX;
/// The file whose creation releases paused learners.
const GO_FILE: &str = "go";

/// A process of a system that is still running.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunningProcess {
    /// The process ID.
    pub pid: i32,
    /// The arguments after the program's name.
    pub args: Vec<String>,
}

impl TestSystem {
    /// Creates a system in a new temporary folder; `program` is the path of the binary under test.
    pub fn new(program: &str) -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        // Not in the target folder: a unix socket's path must be short.
        let folder = tempfile::Builder::new()
            .prefix("driml-test-")
            .tempdir()
            .unwrap();
        Self {
            program: program.into(),
            endpoint: format!("unixsock-stream/{}/s", folder.path().display()),
            folder,
            mark: format!("{}-{count}", std::process::id()),
            tls: "",
            pause_at_updates: AtomicU64::new(NEVER),
        }
    }

    /// Returns this system with another endpoint for its processes.
    pub fn with_endpoint(mut self, endpoint: String) -> Self {
        self.endpoint = endpoint;
        self
    }

    /// Returns this system with TLS, and certificates for three actors in its folder `tls`. Without openssl, reports the test as skipped.
    pub fn over_tls(mut self) -> Option<Self> {
        if !succeeds(Command::new("openssl").arg("version")) {
            return None;
        }
        Certificates::make(self.path("tls"), "--actors 3");
        self.tls = " --tls-dir tls";
        Some(self.with_endpoint(quic_endpoint()))
    }

    /// Returns the certificates of a system that uses TLS.
    pub fn certificates(&self) -> Certificates {
        Certificates::in_folder(self.path("tls"))
    }

    /// Makes learners that start from now on pause after `updates` updates, and report no more, until [`Self::release_learners`]. The run
    /// thus cannot end before a slow test has finished its checks.
    pub fn pause_learners_at(&self, updates: u64) {
        assert!(!self.path(GO_FILE).exists(), "learners were let go before");
        self.pause_at_updates.store(updates, Ordering::Relaxed);
    }

    /// Releases the paused learners; learners that start later do not pause.
    pub fn release_learners(&self) {
        fs::write(self.path(GO_FILE), "").unwrap();
    }

    /// A path in the system's folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The text of a file in the system's folder.
    #[track_caller]
    pub fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
    }

    /// Returns the names of the entries of a folder in the system's folder.
    pub fn file_names(&self, folder: &str) -> Vec<String> {
        let entries = fs::read_dir(self.path(folder)).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        names.collect()
    }

    /// Returns the run folder `name` in the system's folder; it need not exist yet.
    pub fn run_folder(&self, name: &str) -> RunFolder {
        RunFolder::new(self.path(name))
    }

    /// Checks that no process is left and that the run in the folder `run` has this outcome. Returns the run's summary.
    #[track_caller]
    pub fn check_outcome(&self, outcome: Outcome) -> Summary {
        assert_eq!(self.running_processes(), []);
        let summary = self.run_folder("run").summary();
        assert_eq!(summary.outcome, outcome, "{summary:#?}");
        summary
    }

    /// Returns the endpoint that connects this system's processes.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Returns the endpoint of a unix socket in the system's folder.
    pub fn socket_endpoint(&self, name: &str) -> String {
        format!("unixsock-stream/{}", self.path(name).display())
    }

    /// Returns the arguments of a `local` run in the folder `run` at this system's endpoint.
    pub fn local_args(&self, flags: &str) -> String {
        self.listen_args(&format!("local {flags} --run-dir run"))
    }

    /// Returns the arguments of a command that listens at this system's endpoint.
    pub fn listen_args(&self, command: &str) -> String {
        format!("{command} --listen {}{}", self.endpoint, self.tls)
    }

    /// Returns the arguments of a command that connects to this system's replay server.
    pub fn connect_args(&self, command: &str) -> String {
        format!("{command} --connect {}{}", self.endpoint, self.tls)
    }

    /// Starts the program in the system's folder. `args` is split as in a shell: quote arguments that contain blanks.
    ///
    /// `args` may also be a whole command line in which the word `DRIML` stands for the program, for example after `ip netns exec` or `env`
    /// with variables. All processes of a run inherit such variables.
    pub fn start(&self, args: &str) -> Process {
        Process::start(args.to_owned(), self.command(args))
    }

    /// Returns the command that [`Self::start`] starts, for tests that start it in another way.
    pub fn command(&self, args: &str) -> Command {
        let mut line = shlex::split(args).expect("quotes are closed");
        match line.iter().position(|word| word == "DRIML") {
            Some(at) => line[at].clone_from(&self.program),
            None => line.insert(0, self.program.clone()),
        }
        let mut command = Command::new(&line[0]);
        command
            .args(&line[1..])
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            .env(MARK, &self.mark)
            .env_remove("DRIML_LOG");
        let updates = self.pause_at_updates.load(Ordering::Relaxed);
        if updates != NEVER {
            let go = self.path(GO_FILE);
            command.env(fail_point::HOLD_VAR, format!("{updates} {}", go.display()));
        }
        command
    }

    /// Runs the program until it exits.
    pub fn run(&self, args: &str) -> Exit {
        self.start(args).wait()
    }

    /// Runs the program and checks that it succeeds.
    #[track_caller]
    pub fn run_ok(&self, args: &str) -> Exit {
        self.run(args).expect_code(0)
    }

    /// Runs the program, checks that it succeeds, and parses its standard output as JSON.
    #[track_caller]
    pub fn run_json(&self, args: &str) -> serde_json::Value {
        self.run_ok(args).json()
    }

    /// Runs `local` with the run folder `run_dir` until it exits. Returns the summary, checked by [`RunFolder::check_finished`].
    #[track_caller]
    pub fn train(&self, flags: &str, run_dir: &str) -> Summary {
        self.run_ok(&format!("local {flags} --run-dir {run_dir}"));
        self.run_folder(run_dir).check_finished()
    }

    /// Runs the program and checks that it fails with `words` on standard error.
    #[track_caller]
    pub fn fails(&self, args: &str, words: &str) -> Exit {
        self.run(args).expect_code(1).expect_stderr(words)
    }

    /// Runs the program and checks that it rejects its configuration (exit code 64) with `words` on standard error.
    #[track_caller]
    pub fn rejects(&self, args: &str, words: &str) -> Exit {
        self.run(args).expect_code(64).expect_stderr(words)
    }

    /// Checks a table of calls with [`Self::rejects`]. Each line holds a call, ` => `, and the words that standard error must contain.
    #[track_caller]
    pub fn rejects_each(&self, table: &str) {
        for line in table.trim().lines() {
            let (call, words) = line.split_once(" => ").expect("a call => words");
            self.rejects(call.trim(), words);
        }
    }

    /// Starts a process that would otherwise wait for signals forever. The process exits when this test process ends, however that happens.
    pub fn start_process(&self, args: &str) -> Process {
        let parent = std::process::id();
        self.start(&format!("{args} --exit-with-parent {parent}"))
    }

    /// Returns the arguments of a replay server at this system's endpoint, with the settings in `flags`. Like the learner, the server keeps
    /// answering requests after the run is over.
    pub fn replay_server_args(&self, flags: &str) -> String {
        self.listen_args(&format!("replay-server --keep-alive {flags}"))
    }

    /// Starts such a replay server. With TLS, waits until the server listens.
    pub fn start_replay_server(&self, flags: &str) -> Process {
        let mut server = self.start_process(&self.replay_server_args(flags));
        if !self.tls.is_empty() {
            server.wait_for_stderr("replay server listens");
        }
        server
    }

    /// Starts a learner whose checkpoints go into the run folder `run_dir`.
    pub fn start_learner(&self, run_dir: &str) -> Process {
        self.start_process(&self.connect_args(&format!("learner --keep-alive --run-dir {run_dir}")))
    }

    /// Starts an actor.
    pub fn start_actor(&self, id: u32) -> Process {
        self.start_process(&self.connect_args(&format!("actor --id {id}")))
    }

    /// Connects a client to the run at this system's endpoint once its replay server answers. With TLS, the client is an observer.
    pub fn connect(&self) -> Client {
        self.connect_as(Role::Observer)
    }

    /// Connects like [`Self::connect`], but with TLS uses the certificate of `role`.
    pub fn connect_as(&self, role: Role) -> Client {
        let read = || Credentials::read(&self.path("tls"), role).unwrap();
        Client::join(&self.endpoint, (!self.tls.is_empty()).then(read))
    }

    /// Returns a process's connection to the run with this `spec`, without a request to the replay server.
    pub fn run_client(&self, spec: &RunSpec) -> RunClient {
        let keys = Keys::new(NAMESPACE).unwrap();
        RunClient::new(connect(&self.endpoint), keys, spec.hash())
    }

    /// Returns every process of this system that still runs, including children of processes that have ended.
    pub fn running_processes(&self) -> Vec<RunningProcess> {
        let mark = format!("{MARK}={}", self.mark);
        let processes = fs::read_dir("/proc").unwrap().flatten();
        let carries_mark = |folder: &Path| {
            let variables = fs::read(folder.join("environ")).unwrap_or_default();
            let variables = String::from_utf8_lossy(&variables);
            variables.split('\0').any(|variable| variable == mark)
        };
        let running = |entry: fs::DirEntry| {
            let pid = entry.file_name().to_str()?.parse().ok()?;
            // A process that has ended but was not waited for (a zombie) has no environment any more.
            carries_mark(&entry.path()).then_some(())?;
            let words = fs::read(entry.path().join("cmdline")).unwrap_or_default();
            let words = String::from_utf8_lossy(&words);
            let args = words.split('\0').skip(1).filter(|word| !word.is_empty());
            let args = args.map(str::to_owned).collect();
            Some(RunningProcess { pid, args })
        };
        processes.filter_map(running).collect()
    }

    /// Waits for a process with this `role` (`learner`, `actor`, `replay-server`) and returns it.
    pub fn find_process(&self, role: &str) -> RunningProcess {
        wait_for(&format!("a process {role}"), || self.find_process_now(role))
    }

    /// Returns the first process with this `role` that runs now, if any.
    pub fn find_process_now(&self, role: &str) -> Option<RunningProcess> {
        let is_process = |it: &RunningProcess| it.args.first().is_some_and(|first| first == role);
        self.running_processes().into_iter().find(is_process)
    }

    /// Kills every process of this system, launchers first.
    pub fn kill_all(&self) {
        // A dying launcher may start a child while the list is made; the next list contains that child.
        for _ in 0..10 {
            let mut left = self.running_processes();
            if left.is_empty() {
                return;
            }
            let is_child =
                |first: &String| ["replay-server", "learner", "actor"].contains(&&**first);
            left.sort_by_key(|it| it.args.first().is_some_and(is_child));
            left.iter().for_each(|it| it.signal(Signal::SIGKILL));
        }
    }

    /// Waits until no process of this system is left.
    pub fn wait_until_all_have_ended(&self) {
        let all_ended = || self.running_processes().is_empty();
        wait_until("the end of all processes", all_ended);
    }
}

impl RunningProcess {
    /// Returns a number from `/proc/PID/status`, such as `VmRSS`.
    pub fn status(&self, name: &str) -> u64 {
        let text = fs::read_to_string(format!("/proc/{}/status", self.pid)).unwrap();
        let mut lines = text.lines();
        let found = lines.find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
        let number = found.and_then(|rest| rest.split_whitespace().next());
        number.unwrap().parse().unwrap()
    }

    /// Sends a signal. Ignores a process that has already ended.
    pub fn signal(&self, signal: Signal) {
        let _ = kill(Pid::from_raw(self.pid), signal);
    }

    /// Suspends the process. Waits until each thread has stopped, as threads run on for a moment after the signal.
    pub fn suspend(&self) {
        self.signal(Signal::SIGSTOP);
        wait_until("a suspended process", || {
            let mut threads = fs::read_dir(format!("/proc/{}/task", self.pid)).unwrap();
            threads.all(|it| {
                let status = fs::read_to_string(it.unwrap().path().join("status"));
                status.unwrap().contains("State:\tT")
            })
        });
    }
}

impl Drop for TestSystem {
    fn drop(&mut self) {
        self.kill_all();
    }
}
