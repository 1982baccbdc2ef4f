//! What a preset gives up for speed, with its measured gain and price: `presets/variant/prices.toml`.
//! A test holds that each setting in which such a preset differs from `exact` has its row.

use serde::Deserialize;
use toml::{Table, Value};

use crate::overrides::inline;

const PRICES: &str = include_str!("../../presets/variant/prices.toml");

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    price: Vec<Price>,
}

/// A setting that is faster and less exact.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Price {
    /// Its dotted path.
    setting: String,
    value: String,
    /// What `exact` has instead.
    exact: String,
    gain: String,
    cost: String,
}

fn prices() -> Vec<Price> {
    let file: File = toml::from_str(PRICES).unwrap_or_else(|e| {
        panic!("presets/variant/prices.toml is built in, and a test reads it: {e}")
    });
    file.price
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
}

/// What `settings` give up, a line each: what it gains and what it costs.
pub(crate) fn given_up(settings: &Table) -> Vec<String> {
    let prices = prices().into_iter();
    let paid = prices.filter(|price| price.is_paid(settings));
    let line = |Price {
                    setting,
                    value,
                    exact,
                    gain,
                    cost,
                }: Price| {
        format!("{setting} = {value} instead of {exact}. Gain: {gain}. Price: {cost}.")
    };
    paid.map(line).collect()
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
        let prices = prices();
        for world in WorldName::all() {
            for agent in 0..AGENTS.len() {
                let mut exact = Vec::new();
                leaves(&settings("exact", world, agent), "", &mut exact);
                for name in ["fast", "balanced"] {
                    let table = settings(name, world, agent);
                    let mut found = Vec::new();
                    leaves(&table, "", &mut found);
                    found.retain(|leaf| !exact.contains(leaf));
                    assert!(!found.is_empty(), "{name} gives up nothing");
                    for (path, value) in &found {
                        let row = prices
                            .iter()
                            .find(|it| it.setting == *path && it.value == *value);
                        let row =
                            row.unwrap_or_else(|| panic!("{name}: {path} = {value} has no price"));
                        let there = (path.clone(), row.exact.clone());
                        assert!(exact.contains(&there), "{there:?} is not what exact has");
                    }
                    assert_eq!(given_up(&table).len(), found.len(), "{name} in {world}");
                }
                assert!(given_up(&settings("exact", world, agent)).is_empty());
            }
        }
    }

    #[test]
    fn every_price_is_measured() {
        for price in prices() {
            for text in [&price.gain, &price.cost] {
                assert!(
                    text.contains(|c: char| c.is_ascii_digit()),
                    "{price:?} has no number"
                );
            }
        }
    }
}
