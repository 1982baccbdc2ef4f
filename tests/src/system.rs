//! One system: its folder, its mark, and every process that carries the mark.
//! It starts processes and finds them; what they say is for `process` and `client`.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
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
    process::{Ended, Process},
    run_folder::{Outcome, RunFolder, Summary},
    skipped::succeeds,
    waiting::{wait_for, wait_until},
};

/// The variable that marks each process of a system. Children inherit it, so that those of a killed launcher are found too.
const MARK: &str = "DRIML_TEST_SYSTEM";

/// A folder and the processes that were started in it. Dropping it kills those that are left.
#[derive(Debug)]
pub struct TestSystem {
    program: String,
    folder: tempfile::TempDir,
    mark: String,
    /// Where its processes meet: a unix socket unless a test asks for another, so that no port can be taken.
    endpoint: String,
    /// The flag of processes that talk over TLS.
    tls: &'static str,
    /// After how many updates learners that are started wait; none do after [`NEVER`].
    held_at: AtomicU64,
}

/// No learner makes so many updates.
const NEVER: u64 = u64::MAX;
/// The file that learners which are held wait for.
const GO: &str = "go";

/// A process of a system that is still there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Survivor {
    /// Its number.
    pub pid: i32,
    /// Its arguments after the program's name.
    pub args: Vec<String>,
}

impl TestSystem {
    /// A new system, in a fresh folder; `program` is the binary under test.
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
            held_at: AtomicU64::new(NEVER),
        }
    }

    /// This system, whose processes meet at another endpoint.
    pub fn at(mut self, endpoint: String) -> Self {
        self.endpoint = endpoint;
        self
    }

    /// This system, whose processes talk over TLS with certificates in its folder `tls`, of three actors; none where there is no
    /// openssl, and then the test is skipped by name.
    pub fn over_tls(mut self) -> Option<Self> {
        if !succeeds(Command::new("openssl").arg("version")) {
            return None;
        }
        Certificates::make(self.path("tls"), "--actors 3");
        self.tls = " --tls-dir tls";
        Some(self.at(quic_endpoint()))
    }

    /// The certificates of a system over TLS.
    pub fn certificates(&self) -> Certificates {
        Certificates::at(self.path("tls"))
    }

    /// Learners that are started from now on stand still after so many updates, and report no more, until [`Self::let_go`]: their run is
    /// not over before a test has seen and done what it has to, however slow the test is.
    pub fn hold_at(&self, updates: u64) {
        assert!(!self.path(GO).exists(), "learners were let go before");
        self.held_at.store(updates, Ordering::Relaxed);
    }

    /// Releases the learners that are held, and holds no more.
    pub fn let_go(&self) {
        fs::write(self.path(GO), "").unwrap();
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

    /// The names of what lies in a folder of the system's.
    pub fn names(&self, folder: &str) -> Vec<String> {
        let entries = fs::read_dir(self.path(folder)).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        names.collect()
    }

    /// A run folder in the system's folder, whether or not it is there yet.
    pub fn run_folder(&self, name: &str) -> RunFolder {
        RunFolder::new(self.path(name))
    }

    /// Checks that no process is left, and that the run in the folder `run` came to this; gives its summary.
    #[track_caller]
    pub fn check_over(&self, outcome: Outcome) -> Summary {
        assert_eq!(self.survivors(), []);
        let summary = self.run_folder("run").summary();
        assert_eq!(summary.outcome, outcome, "{summary:#?}");
        summary
    }

    /// The endpoint at which this system's processes meet.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// The endpoint of a unix socket in the system's folder.
    pub fn socket(&self, name: &str) -> String {
        format!("unixsock-stream/{}", self.path(name).display())
    }

    /// The call of a run in the folder `run` whose processes meet at this system's endpoint.
    pub fn local(&self, flags: &str) -> String {
        self.listening(&format!("local {flags} --run-dir run"))
    }

    /// The call of a command that listens at this system's endpoint.
    pub fn listening(&self, command: &str) -> String {
        format!("{command} --listen {}{}", self.endpoint, self.tls)
    }

    /// The call of a command that connects to this system's replay server.
    pub fn connected(&self, command: &str) -> String {
        format!("{command} --connect {}{}", self.endpoint, self.tls)
    }

    /// Starts the program in the system's folder, with these arguments as in a shell: quotes are around those that have blanks.
    ///
    /// Or a whole line in which the word `DRIML` is the program: after words that put it on another machine, or `env` with variables, which
    /// all processes of a run inherit.
    pub fn start(&self, args: &str) -> Process {
        Process::start(args.to_owned(), self.command(args))
    }

    /// How [`Self::start`] does it, for tests that start the program in their own way.
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
            .env(MARK, &self.mark)
            .env_remove("DRIML_LOG");
        let updates = self.held_at.load(Ordering::Relaxed);
        if updates != NEVER {
            let go = self.path(GO);
            command.env(fail_point::HOLD, format!("{updates} {}", go.display()));
        }
        command
    }

    /// Runs the program to its end.
    pub fn run(&self, args: &str) -> Ended {
        self.start(args).wait()
    }

    /// Runs the program to its end, which must be a success.
    #[track_caller]
    pub fn run_ok(&self, args: &str) -> Ended {
        self.run(args).expect_code(0)
    }

    /// Runs `local` into the run folder `run_dir` to its end, and gives its summary after [`RunFolder::check_finished`].
    #[track_caller]
    pub fn train(&self, flags: &str, run_dir: &str) -> Summary {
        self.run_ok(&format!("local {flags} --run-dir {run_dir}"));
        self.run_folder(run_dir).check_finished()
    }

    /// Runs the program to its end, which must be an error with `words` on standard error.
    #[track_caller]
    pub fn fails(&self, args: &str, words: &str) -> Ended {
        self.run(args).expect_error(words)
    }

    /// Runs the program to its end, which must be that of a wrong configuration, with `words` on standard error.
    #[track_caller]
    pub fn refuses(&self, args: &str, words: &str) -> Ended {
        self.run(args).expect_code(64).expect_said(words)
    }

    /// Checks a table of calls: a line is a call, ` => `, and the words with which it is refused as [`Self::refuses`] says.
    #[track_caller]
    pub fn refuses_each(&self, table: &str) {
        for line in table.trim().lines() {
            let (call, words) = line.split_once(" => ").expect("a call => words");
            self.refuses(call.trim(), words);
        }
    }

    /// Starts a process that would wait for signals forever; it ends with this test, however that ends.
    pub fn start_process(&self, args: &str) -> Process {
        let parent = std::process::id();
        self.start(&format!("{args} --exit-with-parent {parent}"))
    }

    /// The call of a replay server on this system's endpoint, with the settings that `flags` ask for. When the run is over it stays to be
    /// asked, as the learner does.
    pub fn replay_server(&self, flags: &str) -> String {
        self.listening(&format!("replay-server --keep-alive {flags}"))
    }

    /// Starts such a replay server; over TLS it listens then.
    pub fn start_replay_server(&self, flags: &str) -> Process {
        let mut server = self.start_process(&self.replay_server(flags));
        if !self.tls.is_empty() {
            server.wait_for_stderr("replay server listens");
        }
        server
    }

    /// Starts a learner whose checkpoints go into the run folder `run_dir`.
    pub fn start_learner(&self, run_dir: &str) -> Process {
        self.start_process(&self.connected(&format!("learner --keep-alive --run-dir {run_dir}")))
    }

    /// Starts an actor.
    pub fn start_actor(&self, id: u32) -> Process {
        self.start_process(&self.connected(&format!("actor --id {id}")))
    }

    /// A client of the run at this system's endpoint, once its replay server answers; over TLS, one that only looks.
    pub fn connect(&self) -> Client {
        self.connect_as(Role::Observer)
    }

    /// The same, over TLS with the certificate of `role`.
    pub fn connect_as(&self, role: Role) -> Client {
        let read = || Credentials::read(&self.path("tls"), role).unwrap();
        let credentials = (!self.tls.is_empty()).then(read);
        Client::join(&self.endpoint, credentials.as_ref())
    }

    /// A process's connection to the run with this spec, without any question to its replay server.
    pub fn run_client(&self, spec: &RunSpec) -> RunClient {
        let keys = Keys::new(NAMESPACE).unwrap();
        RunClient::new(connect(&self.endpoint), keys, spec.hash())
    }

    /// Every process of this system that still runs, children of ended ones included.
    pub fn survivors(&self) -> Vec<Survivor> {
        let mark = format!("{MARK}={}", self.mark);
        let processes = fs::read_dir("/proc").unwrap().flatten();
        let carries_mark = |folder: &Path| {
            let variables = fs::read(folder.join("environ")).unwrap_or_default();
            variables
                .split(|&byte| byte == 0)
                .any(|variable| variable == mark.as_bytes())
        };
        let survivor = |entry: fs::DirEntry| {
            let pid = entry.file_name().to_str()?.parse().ok()?;
            // One that has ended and was not waited for has no environment any more.
            carries_mark(&entry.path()).then_some(())?;
            let words = fs::read(entry.path().join("cmdline")).unwrap_or_default();
            let words = words
                .split(|&byte| byte == 0)
                .skip(1)
                .filter(|word| !word.is_empty());
            let args = words
                .map(|word| String::from_utf8_lossy(word).into_owned())
                .collect();
            Some(Survivor { pid, args })
        };
        processes.filter_map(survivor).collect()
    }

    /// The process with this `role` (`learner`, `actor`, `replay-server`), once it is there.
    pub fn find_process(&self, role: &str) -> Survivor {
        wait_for(&format!("a process {role}"), || self.find_process_now(role))
    }

    /// The first process with this `role`, if there is one now.
    pub fn find_process_now(&self, role: &str) -> Option<Survivor> {
        let is_process = |it: &Survivor| it.args.first().is_some_and(|first| first == role);
        self.survivors().into_iter().find(is_process)
    }

    /// Kills every process that the program has started here, launchers first.
    pub fn kill_all(&self) {
        // A child that a dying launcher started while the list was made is in the next list.
        for _ in 0..10 {
            let mut left = self.survivors();
            if left.is_empty() {
                return;
            }
            let is_child =
                |first: &String| ["replay-server", "learner", "actor"].contains(&&**first);
            left.sort_by_key(|it| it.args.first().is_some_and(is_child));
            left.iter().for_each(|it| it.signal(Signal::SIGKILL));
        }
    }

    /// Waits until no process that the program has started here is left.
    pub fn wait_until_all_have_ended(&self) {
        wait_until("the end of all processes", || self.survivors().is_empty());
    }
}

impl Survivor {
    /// A number of the process's status in `/proc`, such as `VmRSS`.
    pub fn status(&self, name: &str) -> u64 {
        let text = fs::read_to_string(format!("/proc/{}/status", self.pid)).unwrap();
        let mut lines = text.lines();
        let found = lines.find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
        let number = found.and_then(|rest| rest.split_whitespace().next());
        number.unwrap().parse().unwrap()
    }

    /// Sends a signal; a process that has ended meanwhile is ignored.
    pub fn signal(&self, signal: Signal) {
        let _ = kill(Pid::from_raw(self.pid), signal);
    }
}

impl Drop for TestSystem {
    fn drop(&mut self) {
        self.kill_all();
    }
}
