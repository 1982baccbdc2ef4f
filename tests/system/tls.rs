//! Mutual TLS in QUIC: files that cannot be used, and clients that are not admitted.
//! Runs over TLS are in `by_hand` and `local`; the permissions of each role are in `refusals::roles`.

use driml_tests::{
    Certificates, EXPIRED, FUTURE, TestSystem, in_parallel, quic_endpoint, wait_for,
};
use zenoh::{Session, Wait};

use crate::{LONG, PATIENT, tls_system};

/// Copies the good certificates to another folder, where a test can make them invalid.
fn tls_copy(system: &TestSystem, name: &str) -> Certificates {
    system.certificates().copy_to(system.path(name))
}

/// Opens a session without driml's checks, with the certificate of a role on one side, `connect` or `listen`. It gives up connecting soon.
fn open_raw(
    side: &str,
    endpoint: &str,
    certificates: &Certificates,
    role: Option<&str>,
) -> zenoh::Result<Session> {
    let file = |name: &str| format!("{:?}", certificates.path(name).display().to_string());
    let own = role.map_or(String::new(), |role| {
        format!(
            ", enable_mtls: true, {side}_certificate: {}, {side}_private_key: {}",
            file(&format!("{role}.pem")),
            file(&format!("{role}.key"))
        )
    });
    let mode = if side == "listen" { "router" } else { "client" };
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", format!("{mode:?}")),
        ("scouting/multicast/enabled", "false".into()),
        ("connect/timeout_ms", "1500".into()),
        ("connect/exit_on_failure", "true".into()),
        (&format!("{side}/endpoints"), format!("[{endpoint:?}]")),
        (
            "transport/link/tls",
            format!("{{ root_ca_certificate: {}{own} }}", file("ca.pem")),
        ),
    ] {
        config.insert_json5(key, &value).unwrap();
    }
    zenoh::open(config).wait()
}

/// Files that are wrong are named before anything is sent.
#[test]
fn own_files_that_cannot_be_used() {
    let Some(system) = tls_system() else { return };
    let key = tls_copy(&system, "key").path("actor-0.key");
    std::fs::copy(system.path("tls/actor-1.key"), key).unwrap();
    std::fs::write(tls_copy(&system, "garbage").path("learner.key"), "no key").unwrap();
    tls_copy(&system, "role").replace_role("learner", "actor-0");
    tls_copy(&system, "number").replace_role("actor-1", "actor-0");
    tls_copy(&system, "old").sign_again("learner", EXPIRED);
    tls_copy(&system, "new").sign_again("learner", FUTURE);
    let foreign = Certificates::make(system.path("foreign"), "--host 10.0.0.1.nip.io");
    let mixed = tls_copy(&system, "mixed").path("ca.pem");
    std::fs::copy(foreign.path("ca.pem"), mixed).unwrap();
    let [actor, learner] = ["actor --id 0", "learner --run-dir run"]
        .map(|role| format!("{role} --connect {} --tls-dir", system.endpoint()));
    let other = |id: u32| actor.replace("--id 0", &format!("--id {id}"));
    system.rejects_each(&format!(
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
    assert!(!system.path("run").exists(), "nothing was begun");

    std::fs::remove_file(system.path("old/replay-server.pem")).unwrap();
    let server = "--tls-dir old --env chain --agent c51";
    system.rejects_each(&format!(
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
    let Some(system) = tls_system() else { return };
    let mut server = system.start_replay_server(&format!("--agent c51 {LONG} {PATIENT}"));
    let observer = system.connect();
    let (learner, actor) = (system.start_learner("run"), system.start_actor(1));
    observer.wait_for_updates(10);
    let foreign = Certificates::make(system.path("foreign"), "");
    std::fs::copy(system.path("tls/ca.pem"), foreign.path("ca.pem")).unwrap();
    let good = system.certificates();
    let old = tls_copy(&system, "old").sign_again("learner", EXPIRED);
    let new = tls_copy(&system, "new").sign_again("learner", FUTURE);
    let endpoint = system.endpoint();
    let attempts = [
        ("none", &good, None),
        ("of another authority", &foreign, Some("learner")),
        ("expired", &old, Some("learner")),
        ("not valid yet", &new, Some("learner")),
        ("a replay server's", &good, Some("replay-server")),
    ];
    let open_good = || open_raw("connect", endpoint, &good, Some("learner")).ok();
    let _accepted = wait_for("a session, else what is below says nothing", open_good);
    // Each attempt lasts until its time-out.
    in_parallel(attempts, |(name, certificates, role)| {
        let opened = open_raw("connect", endpoint, certificates, role);
        assert!(opened.is_err(), "a certificate that is {name}");
    });
    server.wait_for_stderr("QUIC acceptor failed: ");
    // All five together get one line in ten seconds, without the place in zenoh's sources and the false hint after it.
    let log = server.stderr();
    let lines = log.matches("QUIC acceptor failed: ").count();
    assert!(lines < 5 && !log.contains(".rs:"), "{log}");
    // An endpoint without QUIC: nothing listens at this TCP port.
    let plain = system.endpoint().replace("quic/", "tcp/");
    let why = "One with --tls-dir is reached with quic/HOST:PORT";
    system
        .fails(&format!("actor --connect {plain}"), why)
        .expect_stderr("waiting up to 30 s: nothing listens on tcp/");

    // The strangers have not disturbed admitted processes.
    observer.wait_for_updates(observer.learner_status().unwrap().updates + 100);
    assert_eq!(observer.check_nothing_lost().chunks_retried, 0);
    actor.stop(130);
    learner.stop(130);
}

/// A process does not join a stranger in place of its replay server, and names the endpoint.
#[test]
fn strangers_in_the_place_of_a_replay_server() {
    let Some(system) = tls_system() else { return };
    let old = tls_copy(&system, "old").sign_again("replay-server", EXPIRED);
    let new = tls_copy(&system, "new").sign_again("replay-server", FUTURE);
    let foreign = Certificates::make(system.path("foreign"), "");
    let [named, unknowing] = ["named", "unknowing"].map(|name| tls_copy(&system, name));
    tls_copy(&system, "t\u{301}ls");
    for ending in ["pem", "key"] {
        std::fs::remove_file(named.path(&format!("replay-server.{ending}"))).unwrap();
    }
    let named = Certificates::make(system.path("named"), "--host node7.example");
    std::fs::copy(foreign.path("ca.pem"), unknowing.path("ca.pem")).unwrap();
    let (good, server) = (system.certificates(), "replay-server");
    let rows = [
        ("of another authority", Some((&foreign, server))),
        ("expired", Some((&old, server))),
        ("not valid yet", Some((&new, server))),
        ("for another host", Some((&named, server))),
        ("a learner's", Some((&good, "learner"))),
        (
            "good, and this process's is not to it",
            Some((&unknowing, server)),
        ),
        ("not there, as the port is closed", None),
    ]
    .map(|(name, stranger)| {
        let endpoint = quic_endpoint();
        let listening =
            stranger.map(|(files, role)| open_raw("listen", &endpoint, files, Some(role)).unwrap());
        let actor = format!("actor --id 0 --connect {endpoint} --tls-dir t\u{301}ls");
        let actor = system.start_process(&actor);
        (name, endpoint, listening, actor)
    });
    for (name, endpoint, listening, actor) in rows {
        let words = format!("no replay server accepts this process at {endpoint}: ");
        let ended = actor.wait();
        assert_eq!(ended.code, Some(1), "a certificate that is {name}");
        ended
            .expect_stderr(&words)
            .expect_stderr("driml doctor --tls-dir");
        drop(listening);
    }
}

/// For every role that has a file in the folder, the report says whether it can be used, and what to do if not.
#[test]
fn the_doctor_looks_at_certificates() {
    let Some(system) = tls_system() else { return };
    let doctor = |dir: &str| system.run(&format!("doctor --tls-dir {dir}"));
    let well = doctor("tls");
    assert!(!well.stderr.contains("--tls-dir"), "{}", well.stderr);

    let bad = tls_copy(&system, "bad").sign_again("learner", EXPIRED);
    bad.replace_role("actor-0", "observer");
    std::fs::remove_file(bad.path("actor-1.key")).unwrap();
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o644);
    std::fs::set_permissions(bad.path("replay-server.key"), open).unwrap();
    let bad = doctor("bad").expect_code(1);
    let nowhere = doctor("nowhere").expect_code(1);
    let any = "ca.key can sign any certificate";
    for (exit, state, what, words) in [
        (&well, "ok", "tls replay-server", "127.0.0.1"),
        (&well, "ok", "tls learner", "valid until"),
        (&well, "ok", "tls observer", "days)"),
        (&well, "ok", "tls actors", "from 0 to"),
        (&well, "note", "tls authority", any),
        (&bad, "missing", "tls learner", "expired at"),
        (&bad, "missing", "tls observer", "is the certificate of"),
        (&bad, "missing", "tls actor-1", "actor-1.key is not there"),
        (&bad, "note", "tls replay-server", "chmod 600"),
        (&nowhere, "missing", "tls folder", "deploy/certs.sh"),
    ] {
        let is_it = |it: &&str| it.starts_with(state) && it.contains(what) && it.contains(words);
        let found = exit.stdout.lines().find(is_it);
        assert!(found.is_some(), "{state} {what} {words}: {}", exit.stdout);
    }
    // The process itself says the same.
    let server = format!("replay-server --agent c51 {LONG} --tls-dir bad --listen");
    let mut server = system.start_process(&format!("{server} {}", quic_endpoint()));
    server.wait_for_stderr("chmod 600 bad/replay-server.key");
    bad.expect_stderr("these certificates cannot be used: tls learner, tls observer, tls actor-1");
}
