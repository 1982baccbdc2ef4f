//! Weights that a replay server must reject and actors must not use, and run infos that no process may follow: of other runs and versions,
//! from strangers, damaged. The test itself plays the learner or the replay server.

use driml_learner::{Compute, Learner, LearnerConfig};
use driml_protocol::{Keys, RunInfo, WeightsUpload, WeightsVersion, codec, session};
use driml_tests::{Client, listen};
use zenoh::Wait;

use super::{NO_REPLY, Row, check_refused, newer, upload};
use crate::system;

/// The number of the learner that the test plays.
const LEARNER: u64 = 5;

/// Sends weights that the replay server must reject and count as refused.
fn check_rejected(client: &Client, rows: impl IntoIterator<Item = (&'static str, Vec<u8>)>) {
    for (name, bytes) in rows {
        let key = client.keys.key::<WeightsUpload>();
        check_refused(client, name, [Row::new(key, bytes, NO_REPLY)], 1);
    }
}

#[test]
fn only_the_learner_s_whole_and_sound_weights_are_acted_with() {
    let system = system();
    // The test watches only inserts, so the warm-up is nearly as long as the run.
    let flags = "--env chain --agent c51 --preset smoke --set replay.capacity_transitions=20000000 --frames 20000000";
    let _server =
        system.start_replay_server(&format!("{flags} --set replay.warmup_transitions=19000000"));
    let client = system.connect();
    let hash = client.spec.hash();
    let config = LearnerConfig::from_toml(&client.config_toml).unwrap();
    let good = Learner::new(config, &Compute::CPU)
        .unwrap()
        .export_weights()
        .unwrap()
        .safetensors;
    let pack = |version, weights: &[u8], learner| upload(hash, learner, version, weights);
    // Uploads weights that the replay server accepts.
    let accept = |version, weights: &[u8]| {
        let key = client.keys.key::<WeightsUpload>();
        let bytes = pack(version, weights, LEARNER);
        client.request(&key, bytes).unwrap();
    };
    // Announces newer weights, as a stranger could.
    let announce = |version, spec_hash| {
        let bytes = codec::encode(spec_hash, &WeightsVersion { version }, &[]).unwrap();
        let put = client
            .session
            .put(client.keys.key::<WeightsVersion>(), bytes);
        put.wait().unwrap();
    };

    // Until there are usable weights, an actor retries and steps nothing.
    let mut actor = system.start_actor(0);
    actor.wait_for_stderr("waiting for the learner's first weights");
    check_rejected(&client, [("it has not joined", pack(1, &good, LEARNER))]);
    client.join_as_learner(LEARNER);
    let foreign = upload(hash ^ 1, LEARNER, 1, &good);
    check_rejected(&client, [("of another run", foreign)]);
    assert_eq!(client.replay_status().unwrap().transitions_inserted, 0);
    accept(1, &good);
    client.wait_for_transitions(0);

    // Then the actor keeps its weights, whatever is sent.
    let mut damaged = pack(2, &good, LEARNER);
    *damaged.last_mut().unwrap() ^= 1;
    let rows = [
        ("of another protocol", newer(pack(2, &good, LEARNER))),
        ("damaged", damaged),
        ("not a message", b"not weights".to_vec()),
        ("of a stranger", pack(2, &good, LEARNER ^ 1)),
        ("other weights, version 1", pack(1, &good[..40], LEARNER)),
        ("a count no learner reaches", pack(1 << 60, &good, LEARNER)),
        ("older", pack(0, &good, LEARNER)),
    ];
    check_rejected(&client, rows);
    announce(4, hash ^ 1);
    actor
        .wait_for_stderr("an announcement of weights was dropped: the message belongs to run spec");
    // There are no newer weights, so the announcement has no effect.
    announce(1 << 60, hash);
    // These weights come from the right learner but do not fit the network, which shows only when the actor loads them.
    accept(6, &good[..good.len() / 2]);
    actor.wait_for_stderr("weights 6 were rejected, and the previous ones stay in use");
    accept(7, &good);

    let before = client.replay_status().unwrap().transitions_inserted;
    client.wait_for_transitions(before + 1000);
    let stderr = actor.stop(130).stderr;
    assert!(!stderr.contains("newer ones did not arrive"), "{stderr}");
    assert_eq!(client.replay_status().unwrap().transitions_lost, 0);
}

#[test]
fn processes_of_another_protocol_version_do_not_join() {
    let system = system();
    let server = listen(system.endpoint());
    let run_info = RunInfo {
        has_learner: true,
        shard: (0, 1),
        ..RunInfo::default()
    };
    let whole = codec::encode(0, &run_info, &[]).unwrap();
    let run_infos = [
        (newer(whole.clone()), "the same build of driml everywhere"),
        (b"hello?".to_vec(), "it was cut off or padded"),
        (whole, "the settings that the replay server sent"),
    ];
    let key = Keys::new("driml").unwrap().key::<RunInfo>();
    for (bytes, reason) in run_infos {
        let answer = move |query| session::answer(&query, bytes.clone().into());
        let queryable = server
            .declare_queryable(&key)
            .callback(answer)
            .wait()
            .unwrap();
        for process in [system.start_actor(0), system.start_learner("run")] {
            process.fails(reason);
        }
        queryable.undeclare().wait().unwrap();
    }
    let has_begun = system.path("run").exists();
    assert!(!has_begun, "a learner that did not join writes nothing");
    server.close().wait().unwrap();
}
