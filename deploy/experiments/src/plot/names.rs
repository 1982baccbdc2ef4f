//! Names the lines of a plot: world and agent, the settings that differ from other lines with both, and the seeds.
//! This module does not group runs.

use std::collections::BTreeSet;

use super::runs::{Run, Settings};

/// The most settings in a name. Of further settings the name has only the number.
const SETTINGS_MAX: usize = 3;

/// Returns a unique name for each group of runs. The runs of a group differ only in their seeds.
pub(super) fn group_names(groups: &[Vec<&Run>]) -> Vec<String> {
    let name = |runs: &Vec<&Run>| {
        let (Some(world_agent), Some(own)) = (&runs[0].world_agent, &runs[0].settings) else {
            return runs[0].name.clone();
        };
        let peers = groups.iter().map(|other| other[0]);
        let peers = peers.filter(|other| other.world_agent.as_ref() == Some(world_agent));
        let peers: Vec<_> = peers.filter_map(|other| other.settings.as_ref()).collect();
        let mut parts = vec![world_agent.clone()];
        parts.extend(differences(own, &peers));
        parts.push(describe_seeds(runs));
        parts.join(", ")
    };
    let names: Vec<String> = groups.iter().map(name).collect();
    let is_ambiguous = |name: &String| names.iter().filter(|other| *other == name).count() > 1;
    let unique_name = |(name, runs): (&String, &Vec<&Run>)| match is_ambiguous(name) {
        true if *name != runs[0].name => format!("{name} ({})", runs[0].name),
        _ => name.clone(),
    };
    names.iter().zip(groups).map(unique_name).collect()
}

/// Describes the seeds of a group, and says if some seed has several runs: those are not independent samples.
fn describe_seeds(runs: &[&Run]) -> String {
    let seeds: BTreeSet<_> = runs.iter().map(|run| run.seed).collect();
    let seed = |seed: Option<i64>| seed.map_or("unknown".into(), |seed| seed.to_string());
    match (runs.len(), seeds.len()) {
        (1, _) => format!("seed {}", seed(runs[0].seed)),
        (count, 1) => format!("{count} runs of seed {}", seed(runs[0].seed)),
        (count, seeds) if count == seeds => format!("{count} seeds"),
        (count, seeds) => format!("{count} runs of {seeds} seeds"),
    }
}

/// Returns as `name=value` the settings of `own` that are not the same in all `peers`. `peers` include `own`.
fn differences(own: &Settings, peers: &[&Settings]) -> Vec<String> {
    let keys = peers.iter().flat_map(|peer| peer.keys());
    let differs = |key: &&String| peers.iter().any(|peer| peer.get(*key) != own.get(*key));
    let keys: BTreeSet<&String> = keys.filter(differs).collect();
    let setting = |key: &&String| {
        let value = own.get(*key).map_or("unset", String::as_str);
        format!("{}={value}", short_key(key, &keys))
    };
    // Named choices come first, because other settings often follow from them. Then numbers; last lists, and settings that some lack.
    let rank = |key: &&&String| {
        let all = |is: fn(&String) -> bool| peers.iter().all(|it| it.get(**key).is_some_and(is));
        match all(|it| !it.starts_with('[')) {
            true => i32::from(all(|it| it.parse::<f64>().is_ok())),
            false => 2,
        }
    };
    let mut in_order: Vec<&&String> = keys.iter().collect();
    in_order.sort_by_key(rank);
    let told = in_order.into_iter().take(SETTINGS_MAX);
    let mut told: Vec<String> = told.map(setting).collect();
    if keys.len() > SETTINGS_MAX {
        told.push(format!("and {} more settings", keys.len() - SETTINGS_MAX));
    }
    told
}

/// Returns the shortest suffix of a dotted key with which no other of these keys ends.
fn short_key<'a>(key: &'a str, keys: &BTreeSet<&String>) -> &'a str {
    let starts = key.rmatch_indices('.').map(|(at, _)| &key[at + 1..]);
    let unique = |end: &&str| {
        let mut others = keys.iter().filter(|other| other.as_str() != key);
        !others.any(|other| other.ends_with(&format!(".{end}")) || other.as_str() == *end)
    };
    starts.chain([key]).find(unique).unwrap_or(key)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plot::runs::flatten;

    #[test]
    fn what_differs_is_told_by_its_shortest_name() {
        let a = "actors = 1\n[learner.adam]\nlr = 0.1\neps = 1\n[actor]\nlr = 2\n";
        let b =
            "actors = 1\n[learner.adam]\nlr = 0.2\neps = 1\n[actor]\nlr = 3\n[model]\nx = [1]\n";
        let wide = "conv = [8]\nheight = 60\ntorso = 'nature'\n";
        let deep = "height = 64\ntorso = 'impala'\n";
        let many = "a = 1\nb = 1\nc = 1\nd = 1\ne = 1\n";
        for (own, other, expected) in [
            (a, b, "actor.lr=2, adam.lr=0.1, x=unset"),
            (b, a, "actor.lr=3, adam.lr=0.2, x=[1]"),
            (a, a, ""),
            (deep, wide, "torso=impala, height=64, conv=unset"),
            (many, "", "a=1, b=1, c=1, and 2 more settings"),
        ] {
            let [own, other] = [own, other].map(|text| flatten(&text.parse().unwrap()));
            assert_eq!(differences(&own, &[&other, &own]).join(", "), expected);
        }
    }
}
