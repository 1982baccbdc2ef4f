//! The table of episodes: one row per episode, from every shard, across resumes, and if the server no longer keeps some.

use std::fs;

use driml_protocol::Totals;

use super::*;
use crate::testing::{make, run_folder};

/// A shard with `frames` frames and `ended` episodes that have ended. The server keeps the episodes after the first `let_go`, thirty
/// per answer. The return of an episode is `first` plus its number.
#[derive(Clone, Copy)]
struct Shard {
    frames: u64,
    let_go: u64,
    ended: u64,
    first: u64,
    actor: u32,
}

const fn shard(frames: u64, let_go: u64, ended: u64, first: u64) -> Shard {
    Shard {
        frames,
        let_go,
        ended,
        first,
        actor: 4,
    }
}

impl Shard {
    fn status(&self) -> ReplayStatus {
        make(|it: &mut ReplayStatus| {
            (it.transitions_inserted, it.episodes) = (self.frames, self.ended);
        })
    }

    /// The reply to a request; one more episode has ended since the status.
    fn reply(&self, since: u64) -> EpisodesReply {
        let episode = |n| EndedEpisode {
            frames: self.frames,
            actor: self.actor,
            env: 2,
            totals: Some(Totals {
                episode_return: (self.first + n) as f64,
                steps: 9,
            }),
        };
        let ended = self.ended + 1;
        let before = since.clamp(self.let_go, ended);
        EpisodesReply {
            ended,
            before,
            episodes: (before..ended).take(30).map(episode).collect(),
        }
    }
}

fn begun() -> (tempfile::TempDir, RunFolder, TrainingEpisodes) {
    let (root, folder) = run_folder();
    let episodes = TrainingEpisodes::open(&folder, None, None).unwrap();
    (root, folder, episodes)
}

fn update(episodes: &mut TrainingEpisodes, shards: &[Shard]) -> Vec<String> {
    let statuses: Vec<_> = shards.iter().map(Shard::status).collect();
    let fetch = |shard: usize, since| Some(shards[shard].reply(since));
    episodes.update(&statuses, fetch, Some(1.5))
}

fn rows(folder: &RunFolder) -> Vec<String> {
    let text = fs::read_to_string(folder.episodes()).unwrap();
    text.lines().skip(1).map(str::to_owned).collect()
}

/// The mean return, and the number of episodes in it.
fn mean(episodes: &TrainingEpisodes) -> (Option<f64>, usize) {
    let so_far = episodes.so_far(0);
    (so_far.mean_return, so_far.mean_return_of)
}

#[test]
fn every_episode_is_taken_once_from_every_shard() {
    let (_root, folder, mut episodes) = begun();
    assert_eq!(mean(&episodes), (None, 0));
    // In the last update nothing new has ended.
    let later = [shard(20, 1, 3, 0), shard(5, 0, 1, 50)];
    for shards in [[shard(10, 0, 1, 0), shard(5, 0, 0, 50)], later, later] {
        update(&mut episodes, &shards);
    }
    let expected = [
        "1.500,10,1,4,2,0,9",
        "1.500,20,2,4,2,1,9",
        "1.500,20,3,4,2,2,9",
        "1.500,20,4,4,2,50,9",
    ];
    assert_eq!(rows(&folder), expected);
    assert_eq!(mean(&episodes), (Some(53.0 / 4.0), 4));
    assert!(episodes.loss_messages().is_empty());
}

#[test]
fn what_the_server_has_let_go_is_counted_and_said() {
    let (_root, folder, mut episodes) = begun();
    update(&mut episodes, &[shard(10, 0, 5, 0)]);
    let said = update(&mut episodes, &[shard(90, 155, 255, 0)]);
    let why = "episodes.csv lacks 150 episodes: a replay server was restarted, or more ended";
    for said in [&said[0], &episodes.loss_messages()[0]] {
        assert!(said.starts_with(why), "{said}");
    }
    assert_eq!(mean(&episodes), (Some((155.0 + 254.0) / 2.0), 100));
    let rows = rows(&folder);
    assert_eq!(rows.len(), 105);
    // 150 of the episodes have no row, but they have numbers.
    let expected = ["1.500,90,156,4,2,155,9", "1.500,90,255,4,2,254,9"];
    assert_eq!([&rows[5], &rows[104]], expected);
}

#[test]
fn an_episode_of_which_a_part_was_lost_has_a_row_and_no_return() {
    let (_root, folder, mut episodes) = begun();
    let shard = shard(10, 0, 1, 0);
    let fetch = |_, since| {
        let mut reply = shard.reply(since);
        reply.episodes[0].totals = None;
        Some(reply)
    };
    episodes.update(&[shard.status()], fetch, None);
    assert_eq!(rows(&folder), [",10,1,4,2,,"]);
    assert_eq!(mean(&episodes), (None, 0));
    drop(episodes);
    let episodes = TrainingEpisodes::open(&folder, Some(10), Some(0)).unwrap();
    assert_eq!((mean(&episodes), episodes.newest), ((None, 0), 1));
}

#[test]
fn a_run_that_continues_has_the_episodes_before() {
    let (_root, folder, mut episodes) = begun();
    update(&mut episodes, &[shard(1_000, 0, 60, 0)]);
    update(&mut episodes, &[shard(2_000, 60, 70, 0)]);
    // Episodes after the checkpoint do not count, nor does a row that was cut off.
    update(&mut episodes, &[shard(3_000, 70, 90, 0)]);
    let path = folder.episodes();
    fs::write(&path, fs::read_to_string(&path).unwrap() + "1.5,3000,91").unwrap();

    let mut episodes = TrainingEpisodes::open(&folder, Some(2_500), None).unwrap();
    assert_eq!(mean(&episodes), (Some(34.5), 70));
    // Another server counts from the start, while the replay fills again.
    update(&mut episodes, &[shard(1_500, 0, 40, 1_000)]);
    let expected: f64 = (10..70).chain(1_000..1_040).map(f64::from).sum();
    assert_eq!(mean(&episodes), (Some(expected / 100.0), 100));
    assert_eq!(rows(&folder).last().unwrap(), "1.500,2000,110,4,2,1039,9");

    // A server that knows the episodes before, and four more, hands out all that it keeps. A run that ends before its answer keeps all.
    let mut episodes = TrainingEpisodes::open(&folder, Some(2_500), Some(0)).unwrap();
    assert!(update(&mut episodes, &[]).is_empty());
    assert_eq!((rows(&folder).len(), episodes.so_far(0).count), (110, 110));
    update(&mut episodes, &[shard(2_600, 0, 114, 0)]);
    update(&mut episodes, &[shard(2_600, 114, 115, 0)]);
    let text = rows(&folder);
    assert_eq!(text[text.len() - 5], "1.500,2600,111,4,2,110,9");
    assert_eq!(text.last().unwrap(), "1.500,2600,115,4,2,114,9");

    fs::remove_file(&path).unwrap();
    let nothing = TrainingEpisodes::open(&folder, Some(9), None).unwrap();
    assert_eq!(mean(&nothing), (None, 0));
    fs::write(&path, "a,b,c\n1,x,3\n").unwrap();
    let said = TrainingEpisodes::open(&folder, Some(9), None).unwrap_err();
    let said = said.to_string();
    assert!(said.contains("is not a row of episodes"), "{said}");
    // A run that begins does not read the file that it replaces.
    TrainingEpisodes::open(&folder, None, None).unwrap();
    assert_eq!(rows(&folder), [] as [String; 0]);
}

/// The replay began to count after the first thirty episodes.
#[test]
fn a_run_that_was_resumed_without_its_replay_and_then_with_it_has_each_once() {
    let (_root, folder, mut episodes) = begun();
    update(&mut episodes, &[shard(1_000, 0, 30, 0)]);
    let mut episodes = TrainingEpisodes::open(&folder, Some(1_000), None).unwrap();
    update(&mut episodes, &[shard(2_000, 0, 50, 1_000)]);
    let mut episodes = TrainingEpisodes::open(&folder, Some(2_000), Some(30)).unwrap();
    update(&mut episodes, &[shard(3_000, 0, 60, 1_000)]);
    assert_eq!(rows(&folder).len(), 90);
    assert_eq!(rows(&folder)[80], "1.500,3000,81,4,2,1050,9");
}

#[test]
fn what_is_missing_of_one_shard_is_not_taken_from_another() {
    let (_root, folder, mut episodes) = begun();
    let shards = |second| {
        let first = shard(1_000, 0, 100, 0);
        let second = shard(1_000, 0, second, 1_000);
        [first, Shard { actor: 1, ..second }]
    };
    update(&mut episodes, &shards(95));
    let mut episodes = TrainingEpisodes::open(&folder, Some(0), Some(0)).unwrap();
    update(&mut episodes, &shards(100));
    let last: Vec<_> = rows(&folder).split_off(195);
    assert_eq!(last.len(), 5);
    assert_eq!(last[0], "1.500,1000,196,1,2,1095,9");
}
