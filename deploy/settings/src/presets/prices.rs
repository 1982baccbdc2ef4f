//! What the presets `fast` and `balanced` change of `exact` for speed, and the largest price of each that was measured.
//! A test compares the prices with the data in `deploy/experiments/results/tradeoff`.

use toml::{Table, Value};

/// Where the measurements are described.
const MEASUREMENTS: &str = "deploy/experiments/results/tradeoff";

/// A setting that is faster and less exact than that of `exact`.
struct Price {
    /// Its dotted path, which is the dial's name in the data too.
    setting: &'static str,
    value: &'static str,
    /// For the note.
    name: &'static str,
    /// The largest error that was measured, in percent.
    percent: u32,
    /// The price in words; {} is the percentage.
    words: &'static str,
}

/// The most costly first.
const PRICES: [Price; 3] = [
    Price {
        setting: "learner.precision",
        value: "bf16",
        name: "bf16 learner",
        percent: 15,
        words: "gradients off by up to {}%",
    },
    Price {
        setting: "actor.precision",
        value: "bf16",
        name: "bf16 actors",
        percent: 6,
        words: "another greedy action in up to {}% of states",
    },
    Price {
        setting: "learner.publish_as",
        value: "f16",
        name: "f16 weights",
        percent: 1,
        words: "another greedy action in up to {}% of states",
    },
];

impl Price {
    fn is_paid(&self, settings: &Table) -> bool {
        let value = self.setting.split_once('.').and_then(|(table, key)| {
            let table = settings.get(table)?.as_table()?;
            table.get(key).and_then(Value::as_str)
        });
        value == Some(self.value)
    }
}

/// One line about what `settings`, made by the preset of this name, give up; none if they give up nothing.
pub(crate) fn note(preset: &str, settings: &Table) -> Option<String> {
    let paid: Vec<_> = PRICES.iter().filter(|it| it.is_paid(settings)).collect();
    let worst = paid.first()?;
    let names: Vec<_> = paid.iter().map(|it| it.name).collect();
    let price = worst.words.replace("{}", &worst.percent.to_string());
    Some(format!(
        "{preset}: {}; {price}, see {MEASUREMENTS}",
        names.join(", ")
    ))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use driml_envs::WorldName;
    use expect_test::expect;

    use super::*;
    use crate::{
        overrides::inline,
        presets::{AGENTS, layers, preset},
    };

    /// Dotted paths and values of everything that is not a table.
    fn leaves(table: &Table, path: &str, into: &mut Vec<(String, String)>) {
        for (key, value) in table {
            let path = format!("{path}{key}");
            match value {
                Value::Table(inner) => leaves(inner, &format!("{path}."), into),
                other => into.push((path, inline(other))),
            }
        }
    }

    fn settings(name: &str, world: WorldName, agent: usize) -> Table {
        layers(preset(name).unwrap(), world, &AGENTS[agent]).unwrap()
    }

    #[test]
    fn every_setting_that_is_given_up_has_its_price() {
        for world in WorldName::all() {
            for agent in 0..AGENTS.len() {
                let mut exact = Vec::new();
                leaves(&settings("exact", world, agent), "", &mut exact);
                for name in ["fast", "balanced"] {
                    let mut found = Vec::new();
                    leaves(&settings(name, world, agent), "", &mut found);
                    found.retain(|leaf| !exact.contains(leaf));
                    for (path, value) in &found {
                        let has_price = PRICES
                            .iter()
                            .any(|it| it.setting == path && it.value == value);
                        assert!(has_price, "{name}: {path} = {value} has no price");
                    }
                }
                assert_eq!(note("exact", &settings("exact", world, agent)), None);
            }
        }
    }

    #[test]
    fn a_preset_has_one_line_with_one_number() {
        let mut table = settings("fast", "mspacman".parse().unwrap(), 0);
        let fast = note("fast", &table).unwrap();
        expect!["fast: bf16 learner, bf16 actors, f16 weights; gradients off by up to 15%, see deploy/experiments/results/tradeoff"].assert_eq(&fast);
        table["learner"]["precision"] = "f32".into();
        expect!["fast: bf16 actors, f16 weights; another greedy action in up to 6% of states, see deploy/experiments/results/tradeoff"].assert_eq(&note("fast", &table).unwrap());
    }

    #[test]
    fn the_prices_are_the_largest_that_were_measured() {
        let pages = [
            include_str!("../../../experiments/results/tradeoff/mspacman/levels.csv"),
            include_str!("../../../experiments/results/tradeoff/coinrun/levels.csv"),
            include_str!("../../../experiments/results/tradeoff/fruitbot/levels.csv"),
        ];
        let rows: Vec<BTreeMap<String, String>> = pages
            .iter()
            .flat_map(|page| csv::Reader::from_reader(page.as_bytes()).into_deserialize())
            .collect::<Result<_, _>>()
            .unwrap();
        let largest =
            |dials: &[&str], levels: &[&str], error: fn(&BTreeMap<String, String>) -> f64| {
                let is_of = |row: &&BTreeMap<String, String>| {
                    dials.contains(&&*row["dial"]) && levels.contains(&&*row["level"])
                };
                (100.0 * rows.iter().filter(is_of).map(error).fold(0.0, f64::max)).ceil() as u32
            };
        let gradient =
            |row: &BTreeMap<String, String>| row["gradient_error"].parse::<f64>().unwrap();
        let action =
            |row: &BTreeMap<String, String>| 1.0 - row["same_action_actor"].parse::<f64>().unwrap();
        let [learner, actor, weights] = PRICES.map(|it| it.percent);
        let presets = ["preset", "preset with DIM"];
        let of_learner = [presets[0], presets[1], "learner.precision"];
        assert_eq!(learner, largest(&of_learner, &["fast", "bf16"], gradient));
        let of_actor = [presets[0], presets[1], "actor.precision"];
        assert_eq!(actor, largest(&of_actor, &["balanced", "bf16"], action));
        assert_eq!(weights, largest(&["learner.publish_as"], &["f16"], action));
    }
}
