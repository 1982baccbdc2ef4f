//! What a preset gives up for speed, with its measured gain and price: `presets/variant/prices.toml` and the figures of the experiments.
//! A test holds that each setting in which such a preset differs from `exact` has its row. It measures nothing.

mod measured;

use std::collections::BTreeMap;

use serde::Deserialize;
use toml::{Table, Value};

use self::measured::{Measured, Number, Page};
use crate::overrides::inline;

const PRICES: &str = include_str!("../../presets/variant/prices.toml");

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    price: Vec<Price>,
    /// The settings that each preset gives up.
    whole: BTreeMap<String, Vec<String>>,
    together: Vec<Together>,
}

/// A setting that is faster and less exact.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Price {
    /// Its dotted path, which is the dial's name too.
    setting: String,
    value: String,
    /// What `exact` has instead.
    exact: String,
    gain: Number,
    error: Number,
}

/// A dial whose levels are whole presets.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Together {
    dial: String,
    text: String,
}

fn file() -> File {
    toml::from_str(PRICES).unwrap_or_else(|e| {
        panic!("presets/variant/prices.toml is built in, and a test reads it: {e}")
    })
}

impl Price {
    fn is_paid(&self, settings: &Table) -> bool {
        let (tables, key) = self.setting.rsplit_once('.').unwrap_or(("", &self.setting));
        let inner = tables.split('.').filter(|name| !name.is_empty());
        let inner = inner
            .into_iter()
            .try_fold(settings, |table, name| table.get(name)?.as_table());
        let value: Option<&Value> = inner.and_then(|table| table.get(key));
        value.is_some_and(|value| inline(value) == self.value)
    }

    fn line(&self, pages: &[Page]) -> String {
        let Self {
            setting,
            value,
            exact,
            gain,
            error,
        } = self;
        let measured: Vec<(&str, Measured<'_>)> = pages
            .iter()
            .filter_map(|page| Some((page.name, page.measured(setting, value)?)))
            .collect();
        let each = |text: &dyn Fn(&Measured<'_>) -> Option<String>| {
            measured.iter().filter_map(|(_, it)| text(it)).collect()
        };
        let in_words = |number: &Number| {
            let of_level = joined(each(&|it| it.level(number)));
            let of_base = joined(each(&|it| it.base(number)));
            let text = number.text.replace("{}", &of_level);
            text.replace("{base}", &of_base)
        };
        format!(
            "{setting} = {value} instead of {exact}. On {}. Gain: {}. Price: {}; training return {}.",
            joined(
                measured
                    .iter()
                    .map(|(name, _)| (*name).to_owned())
                    .collect()
            ),
            in_words(gain),
            in_words(error),
            joined(each(&|it| it.training_return())),
        )
    }
}

/// "a, b and c".
fn joined(mut items: Vec<String>) -> String {
    match (items.pop(), items.is_empty()) {
        (None, _) => String::new(),
        (Some(only), true) => only,
        (Some(last), false) => format!("{} and {last}", items.join(", ")),
    }
}

impl Together {
    /// What the preset `level` as a whole does; nothing if it was never run.
    fn line(&self, level: &str, pages: &[Page]) -> Option<String> {
        let each = pages.iter().filter_map(|page| {
            let measured = page.measured(&self.dial, level)?;
            let (learning, acting) = (measured.factor("rows_gain")?, measured.factor("act_gain")?);
            Some(format!(
                "{}: {learning} times the rows learned from a second, {acting} times the actions, training return {}",
                page.name,
                measured.training_return()?
            ))
        });
        let each: Vec<String> = each.collect();
        (!each.is_empty()).then(|| format!("{}. {}.", self.text, each.join("; ")))
    }
}

/// What `settings`, by the preset of this name, give up: a line for each setting with its gain and its price, and what they do together
/// where all of the preset's are as it has them.
pub(crate) fn given_up(preset: &str, settings: &Table) -> Vec<String> {
    let (file, pages) = (file(), measured::pages());
    let mut paid = file.price;
    paid.retain(|price| price.is_paid(settings));
    let mut lines: Vec<String> = paid.iter().map(|price| price.line(&pages)).collect();
    let is_paid = |setting: &String| paid.iter().any(|price| price.setting == *setting);
    if file
        .whole
        .get(preset)
        .is_some_and(|all| all.iter().all(is_paid))
    {
        let together = file.together.iter();
        lines.extend(together.filter_map(|it| it.line(preset, &pages)));
    }
    lines
}

#[cfg(test)]
mod tests {
    use driml_envs::WorldName;

    use super::*;
    use crate::presets::{AGENTS, layers, preset};

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
        let File { price, whole, .. } = file();
        for world in WorldName::all() {
            for agent in 0..AGENTS.len() {
                let mut exact = Vec::new();
                leaves(&settings("exact", world, agent), "", &mut exact);
                for name in ["fast", "balanced"] {
                    let table = settings(name, world, agent);
                    let mut found = Vec::new();
                    leaves(&table, "", &mut found);
                    found.retain(|leaf| !exact.contains(leaf));
                    let mut paths: Vec<&String> = found.iter().map(|(path, _)| path).collect();
                    let mut said: Vec<&String> = whole[name].iter().collect();
                    paths.sort();
                    said.sort();
                    assert_eq!(paths, said, "{name} in {world}");
                    for (path, value) in &found {
                        let row = price
                            .iter()
                            .find(|it| it.setting == *path && it.value == *value);
                        let row =
                            row.unwrap_or_else(|| panic!("{name}: {path} = {value} has no price"));
                        let there = (path.clone(), row.exact.clone());
                        assert!(exact.contains(&there), "{there:?} is not what exact has");
                    }
                    let given_up = given_up(name, &table);
                    for path in paths {
                        let of = format!("{path} = ");
                        assert!(given_up.iter().any(|line| line.starts_with(&of)), "{of}");
                    }
                }
                assert!(given_up("exact", &settings("exact", world, agent)).is_empty());
            }
        }
    }

    #[test]
    fn every_price_is_measured_on_every_page() {
        for price in file().price {
            for page in measured::pages() {
                let measured = page.measured(&price.setting, &price.value).unwrap();
                for number in [&price.gain, &price.error] {
                    assert!(number.text.contains("{}"), "{number:?}");
                    assert!(measured.level(number).is_some() && measured.base(number).is_some());
                }
                assert!(measured.training_return().is_some(), "{}", page.name);
            }
        }
    }

    #[test]
    fn a_preset_that_is_not_whole_says_nothing_of_the_whole() {
        let mut table = settings("fast", "mspacman".parse().unwrap(), 0);
        let together = |table: &Table| {
            let lines = given_up("fast", table).into_iter();
            lines.filter(|line| line.starts_with("all of it")).count()
        };
        assert!(together(&table) > 0);
        table["learner"]["precision"] = "f32".into();
        assert_eq!(together(&table), 0);
    }
}
