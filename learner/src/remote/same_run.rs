//! Checks that replay servers are the shards of one run: their settings agree, apart from what each server's machine decides.
//! It connects to nothing.

use anyhow::{Context, ensure};
use driml_protocol::RunInfo;

/// The settings that may differ between shards, beside the table `[local]`: the machine of each server decides them.
const OF_THE_MACHINE: [(&[&str], &str); 5] = [
    (&["actor"], "precision"),
    (&["actor", "epsilon_ladder"], "actors"),
    (&["learner"], "precision"),
    (&["replay"], "capacity_transitions"),
    (&["replay"], "compressed_bytes_max"),
];

/// Checks that the endpoints are all shards of one run, and returns the run's information.
pub(super) fn single_run<'a>(
    connect: &[String],
    run_infos: &'a [RunInfo],
) -> anyhow::Result<&'a RunInfo> {
    let first = run_infos
        .first()
        .context("no endpoint of a replay server was given")?;
    let shared = shared_settings(&first.config_toml)?;
    for (at, run_info) in run_infos.iter().enumerate() {
        let (endpoint, shard) = (&connect[at], run_info.shard.0);
        ensure!(
            shared_settings(&run_info.config_toml)? == shared,
            "{endpoint} and {} are replay servers of runs with different settings: start both with the same",
            connect[0]
        );
        if let Some(earlier) = run_infos[..at].iter().position(|it| it.shard.0 == shard) {
            anyhow::bail!(
                "{} and {endpoint} are both shard {shard}: start each replay server with its own --shard, and give each endpoint once",
                connect[earlier]
            );
        }
    }
    let count = first.shard.1 as usize;
    ensure!(
        run_infos.len() == count,
        "the run's replay has {count} shards, and --connect names {}: give it once for each shard",
        run_infos.len()
    );
    Ok(first)
}

/// The settings that all shards must share: those that do not follow from the machine on which each server started.
fn shared_settings(config_toml: &str) -> anyhow::Result<toml::Table> {
    let mut shared: toml::Table = config_toml.parse()?;
    shared.remove("local");
    for (tables, key) in OF_THE_MACHINE {
        let mut table = Some(&mut shared);
        for &name in tables {
            table = table.and_then(|it| it.get_mut(name)?.as_table_mut());
        }
        table.and_then(|it| it.remove(key));
    }
    Ok(shared)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_that_do_not_make_one_replay_are_refused() {
        let run_info = |config: &str, shard| RunInfo {
            config_toml: config.into(),
            shard,
            ..RunInfo::default()
        };
        let connect = ["a".to_owned(), "b".to_owned()];
        let said = |run_infos: &[RunInfo]| single_run(&connect, run_infos).unwrap_err().to_string();
        let config = |precision: &str, capacity: u32, ratio: u32| {
            format!(
                "[local]\nactors = {capacity}\n[actor]\nprecision = {precision:?}\nepsilon_ladder = {{ base = 0.4, actors = {capacity} }}\n[replay]\ncapacity_transitions = {capacity}\nreplay_ratio = {ratio}\n"
            )
        };
        let [ours, theirs] = [config("f32", 7, 2), config("bf16", 9, 2)];
        let other_run = config("f32", 7, 4);
        for (infos, expected) in [
            (
                &[(&ours, (0, 2)), (&other_run, (1, 2))][..],
                "different settings",
            ),
            (&[(&ours, (1, 2)), (&ours, (1, 2))], "both shard 1"),
            (&[(&ours, (0, 3)), (&ours, (1, 3))], "has 3 shards"),
            (&[(&ours, (0, 2))], "has 2 shards"),
        ] {
            let infos: Vec<_> = infos
                .iter()
                .map(|(it, shard)| run_info(it, *shard))
                .collect();
            let said = said(&infos);
            assert!(said.contains(expected), "{said}");
        }
        // What follows from each server's machine may differ.
        let whole = [run_info(&ours, (1, 2)), run_info(&theirs, (0, 2))];
        assert_eq!(single_run(&connect, &whole).unwrap().config_toml, ours);
    }
}
