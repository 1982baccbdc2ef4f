//! Mutual TLS in QUIC: a run over it, files that cannot be used, and clients that are not admitted.
//! What each role may do is in `refusals::roles`.

use std::{
    net::UdpSocket,
    process::Command,
    time::{Duration, Instant},
};

use driml_protocol::{
    Keys,
    session::{self, Endpoints},
    tls::{Credentials, Role},
};
use driml_tests::{
    Certificates, Client, EXPIRED, FUTURE, Outcome, Process, TestSystem, at_once, succeeds,
    wait_until,
};
use nix::sys::signal::Signal;
use zenoh::{Session, Wait};

use crate::{LONG, SHORT, system};

/// How soon a rejection is reported, on a busy machine too.
const SECONDS: Duration = Duration::from_secs(30);

/// A system whose processes talk over TLS.
pub(crate) struct TlsSystem {
    pub(crate) system: TestSystem,
    pub(crate) good: Certificates,
    pub(crate) endpoint: String,
}

impl TlsSystem {
    /// With certificates for some actors; none where there is no openssl, and then the test is skipped by name.
    pub(crate) fn new() -> Option<Self> {
        if !succeeds(Command::new("openssl").arg("version")) {
            return None;
        }
        let system = system();
        let good = Certificates::make(system.path("tls"), "--actors 3");
        Some(Self {
            system,
            good,
            endpoint: format!("quic/127.0.0.1:{}", free_port()),
        })
    }

    pub(crate) fn start_server(&self, flags: &str) -> Process {
        let mut server = self.system.start_process(&format!(
            "replay-server --keep-alive --listen {} --tls-dir tls {flags}",
            self.endpoint
        ));
        server.wait_for_stderr("replay server listens");
        server
    }

    /// Starts an actor or a learner with the certificates in `folder`.
    pub(crate) fn start(&self, command: &str, folder: &str) -> Process {
        let endpoint = &self.endpoint;
        let args = format!("{command} --connect {endpoint} --tls-dir {folder}");
        self.system.start_process(&args)
    }

    /// Good certificates in another folder, to be spoiled there.
    fn spoiled(&self, name: &str) -> Certificates {
        self.good.copy(self.system.path(name))
    }

    /// A client with the certificate of `role`, as this program opens its sessions.
    pub(crate) fn client(&self, role: Role) -> Client {
        let credentials = Credentials::read(self.good.folder(), role).unwrap();
        let endpoints = Endpoints::to(vec![self.endpoint.clone()]);
        let keys = Keys::new("driml").unwrap();
        let session = session::open_as(
            &endpoints,
            &keys,
            Some(&credentials),
            session::SMALL_MESSAGE_BYTES_MAX,
        )
        .unwrap();
        Client::over(session)
    }
}

/// A stranger in the place of a replay server.
fn listen_raw(endpoint: &str, certificates: &Certificates, role: &str) -> Session {
    let own = raw_tls("listen", certificates, Some(role));
    open_raw(&[
        ("mode", "\"router\"".into()),
        ("listen/endpoints", format!("[{endpoint:?}]")),
        ("transport/link/tls", own),
    ])
    .unwrap()
}

/// An unused port of this machine.
fn free_port() -> u16 {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.local_addr().unwrap().port()
}

/// Opens a session with zenoh alone, without any check of ours; as a client it gives up soon.
fn open_raw(settings: &[(&str, String)]) -> zenoh::Result<Session> {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"client\"".to_owned()),
        ("scouting/multicast/enabled", "false".into()),
        ("connect/timeout_ms", "1500".into()),
        ("connect/exit_on_failure", "true".into()),
    ]
    .iter()
    .chain(settings)
    {
        config.insert_json5(key, value).unwrap();
    }
    zenoh::open(config).wait()
}

/// zenoh's settings for one side of a connection, `connect` or `listen`.
fn raw_tls(side: &str, certificates: &Certificates, role: Option<&str>) -> String {
    let file = |name: &str| format!("{:?}", certificates.path(name).display().to_string());
    let own = role.map_or(String::new(), |role| {
        format!(
            ", enable_mtls: true, {side}_certificate: {}, {side}_private_key: {}",
            file(&format!("{role}.pem")),
            file(&format!("{role}.key"))
        )
    });
    format!("{{ root_ca_certificate: {}{own} }}", file("ca.pem"))
}

#[test]
fn a_run_over_tls() {
    let Some(tls) = TlsSystem::new() else { return };
    let server = tls.start_server(&format!("--agent driml-ada {SHORT}"));
    let observer = tls.client(Role::Observer);
    let learner = tls.start("learner --keep-alive --run-dir run", "tls");
    let actors = [
        tls.start("actor --id 0", "tls"),
        tls.start("actor --id 2", "tls"),
    ];
    for actor in actors {
        actor.wait_ok().expect_said("leaves: ");
    }
    observer.wait_for_learner("the learner's last update", |learner| learner.finished);
    let replay = observer.check_nothing_lost();
    assert_eq!(
        (replay.transitions_inserted, replay.rows_sampled),
        (1280, 8640)
    );
    // No process asked for more than its role allows.
    assert_eq!(replay.messages_refused, 0);
    assert!(
        replay.affinity_version > 0,
        "the learner's affinity arrived"
    );
    learner.stop_ok().expect_said("finished after 540");
    drop(observer);
    server.stop_ok();
}

/// Its processes meet at a unix socket, and one more comes from outside.
#[test]
fn a_launched_run_with_an_actor_from_outside() {
    let Some(tls) = TlsSystem::new() else { return };
    let run = tls.system.start(&format!(
        "local --agent c51 {LONG} --listen {} --tls-dir tls --run-dir run",
        tls.endpoint
    ));
    let mut outside = tls.start("actor --id 2", "tls");
    outside.wait_for_stderr("actor 2 steps");
    let observer = tls.client(Role::Observer);
    observer.wait_for_replay("both actors", |replay| replay.actors_acting == 2);
    // Who only looks gets all that is recorded, episodes too.
    let mut watched = tls.system.start(&format!(
        "watch --connect {} --tls-dir tls --run-dir seen",
        tls.endpoint
    ));
    let seen = tls.system.run_folder("seen");
    wait_until("episodes of both actors", || {
        let episodes = seen.episodes();
        let is_there = |&actor: &u64| episodes.iter().any(|it| it.actor == actor);
        [0, 2].iter().all(is_there)
    });
    watched.signal(Signal::SIGINT);
    watched.wait_for_stderr("the run continues without being watched");
    watched.wait().expect_code(130);
    outside.stop_ok().expect_said("leaves: ");
    drop(observer);
    run.stop().expect_code(130);
    tls.system.run_folder("run").check(Outcome::Interrupted);
}

/// Files that are wrong are named before anything is sent.
#[test]
fn own_files_that_cannot_be_used() {
    let Some(tls) = TlsSystem::new() else { return };
    let key = tls.spoiled("key").path("actor-0.key");
    std::fs::copy(tls.good.path("actor-1.key"), key).unwrap();
    std::fs::write(tls.spoiled("garbage").path("learner.key"), "no key").unwrap();
    tls.spoiled("role").pass_off("learner", "actor-0");
    tls.spoiled("number").pass_off("actor-1", "actor-0");
    tls.spoiled("old").sign_again("learner", EXPIRED);
    tls.spoiled("new").sign_again("learner", FUTURE);
    let foreign = Certificates::make(tls.system.path("foreign"), "");
    let mixed = tls.spoiled("mixed").path("ca.pem");
    std::fs::copy(foreign.path("ca.pem"), mixed).unwrap();
    let [actor, learner] = ["actor --id 0", "learner --run-dir run"]
        .map(|role| format!("{role} --connect {} --tls-dir", tls.endpoint));
    let other = |id: u32| actor.replace("--id 0", &format!("--id {id}"));
    tls.system.refuses_each(&format!(
        "
        {} tls => tls/actor-9.pem is not there: the role actor-9 needs ca.pem, actor-9.pem and actor-9.key; `deploy/certs.sh tls --actors 10` makes them
        {} tls => actors have the numbers 0 to 1023
        {actor} nowhere => nowhere/ca.pem is not there
        {actor} role => role/actor-0.pem is the certificate of \"learner\", not of \"actor-0\"
        {actor} number => is the certificate of \"actor-1\", not of \"actor-0\"
        {actor} key => key/actor-0.key is not the key of key/actor-0.pem
        {learner} garbage => garbage/learner.key holds no private key in PEM
        {learner} old => old/learner.pem expired at
        {learner} new => new/learner.pem is valid only from
        {learner} mixed => mixed/learner.pem was not signed by the authority of mixed/ca.pem
        ",
        other(9),
        other(1024)
    ));
    assert!(!tls.system.path("run").exists(), "nothing was begun");

    std::fs::remove_file(tls.system.path("old/replay-server.pem")).unwrap();
    let server = "--tls-dir old --env chain --agent c51";
    tls.system.refuses_each(&format!(
        "
        replay-server --listen quic/127.0.0.1:1 {server} => old/replay-server.pem is not there
        replay-server --listen tcp/127.0.0.1:1 {server} => it is quic/127.0.0.1:1
        actor --connect quic/127.0.0.1:1 => add --tls-dir DIR
        "
    ));
}

/// A replay server rejects each certificate that is not good, and logs why; accepted connections stay.
#[test]
fn strangers_at_a_replay_server() {
    let Some(tls) = TlsSystem::new() else { return };
    let mut server = tls.start_server(&format!("--agent c51 {LONG}"));
    let observer = tls.client(Role::Observer);
    let foreign = Certificates::make(tls.system.path("foreign"), "");
    std::fs::copy(tls.good.path("ca.pem"), foreign.path("ca.pem")).unwrap();
    let old = tls.spoiled("old").sign_again("learner", EXPIRED);
    let new = tls.spoiled("new").sign_again("learner", FUTURE);
    let endpoint = &tls.endpoint;
    let attempts = [
        ("none", &tls.good, None),
        ("of another authority", &foreign, Some("learner")),
        ("expired", &old, Some("learner")),
        ("not valid yet", &new, Some("learner")),
        ("a replay server's", &tls.good, Some("replay-server")),
    ];
    // Each takes as long as it may to give up.
    at_once(attempts, |(name, certificates, role)| {
        let opened = open_raw(&[
            ("connect/endpoints", format!("[{endpoint:?}]")),
            ("transport/link/tls", raw_tls("connect", certificates, role)),
        ]);
        assert!(opened.is_err(), "a certificate that is {name}");
    });
    server.wait_for_stderr("QUIC acceptor failed: ");
    // Without QUIC, at whose port nothing listens.
    let plain = tls.endpoint.replace("quic/", "tcp/");
    let started = Instant::now();
    let why = "One with --tls-dir is reached with quic/HOST:PORT";
    tls.system.fails(&format!("actor --connect {plain}"), why);
    assert!(started.elapsed() < SECONDS);

    // Who is let in is not disturbed.
    let learner = tls.start("learner --keep-alive --run-dir run", "tls");
    let actor = tls.start("actor --id 1", "tls");
    observer.wait_for_updates(10);
    actor.stop_ok();
    learner.stop_ok();
}

/// A process does not follow a stranger in the place of its replay server, and names the endpoint.
#[test]
fn strangers_in_the_place_of_a_replay_server() {
    let Some(tls) = TlsSystem::new() else { return };
    let old = tls.spoiled("old").sign_again("replay-server", EXPIRED);
    let new = tls.spoiled("new").sign_again("replay-server", FUTURE);
    let foreign = Certificates::make(tls.system.path("foreign"), "");
    let [named, unknowing] = ["named", "unknowing"].map(|name| tls.spoiled(name));
    for ending in ["pem", "key"] {
        std::fs::remove_file(named.path(&format!("replay-server.{ending}"))).unwrap();
    }
    let named = Certificates::make(named.folder().to_owned(), "--host node7.example");
    std::fs::copy(foreign.path("ca.pem"), unknowing.path("ca.pem")).unwrap();
    let server = "replay-server";
    let rows = [
        ("of another authority", Some((&foreign, server))),
        ("expired", Some((&old, server))),
        ("not valid yet", Some((&new, server))),
        ("for another host", Some((&named, server))),
        ("a learner's", Some((&tls.good, "learner"))),
        (
            "good, and this process's is not to it",
            Some((&unknowing, server)),
        ),
        ("not there, as the port is closed", None),
    ]
    .map(|(name, stranger)| {
        let endpoint = format!("quic/127.0.0.1:{}", free_port());
        let listening = stranger.map(|(files, role)| listen_raw(&endpoint, files, role));
        let actor = format!("actor --id 0 --connect {endpoint} --tls-dir tls");
        let actor = tls.system.start_process(&actor);
        (name, endpoint, listening, actor)
    });
    for (name, endpoint, listening, actor) in rows {
        let words = format!("no replay server lets this process in on {endpoint}: ");
        let ended = actor.wait();
        assert_eq!(ended.code, Some(1), "a certificate that is {name}");
        ended
            .expect_said(&words)
            .expect_said("driml doctor --tls-dir");
        drop(listening);
    }
}

/// For every role that has a file in the folder, the report says whether it can be used, and what to do if not.
#[test]
fn the_doctor_looks_at_certificates() {
    let Some(tls) = TlsSystem::new() else { return };
    let doctor = |dir: &str| tls.system.run(&format!("doctor --tls-dir {dir}"));
    let well = doctor("tls");
    let said = |ended: &driml_tests::Ended, state: &str, what: &str, words: &str| {
        let line = |it: &&str| it.starts_with(state) && it.contains(what) && it.contains(words);
        let found = ended.stdout.lines().find(line);
        assert!(found.is_some(), "{state} {what} {words}: {}", ended.stdout);
    };
    for (what, words) in [
        ("tls replay-server", "127.0.0.1"),
        ("tls learner", "good until"),
        ("tls observer", "days)"),
        ("tls actors", "from 0 to"),
    ] {
        said(&well, "ok", what, words);
    }
    said(&well, "note", "tls authority", "ca.key is here");
    assert!(!well.stderr.contains("--tls-dir"), "{}", well.stderr);

    let bad = tls.spoiled("bad").sign_again("learner", EXPIRED);
    bad.pass_off("actor-0", "observer");
    std::fs::remove_file(bad.path("actor-1.key")).unwrap();
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o644);
    std::fs::set_permissions(bad.path("replay-server.key"), open).unwrap();
    let ended = doctor("bad").expect_code(1);
    said(&ended, "missing", "tls learner", "expired at");
    said(&ended, "missing", "tls observer", "is the certificate of");
    said(&ended, "missing", "tls actor-1", "actor-1.key is not there");
    said(&ended, "note", "tls replay-server", "chmod 600");
    ended.expect_said("these certificates cannot be used: tls learner, tls observer, tls actor-1");
    said(
        &doctor("nowhere").expect_code(1),
        "missing",
        "tls folder",
        "deploy/certs.sh",
    );
}
