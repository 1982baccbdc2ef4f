//! How a process reads its own tables from the run's resolved settings, and how it reports a value that cannot work.
//! The content of the tables is not known here: each crate defines its Config.

use std::{fmt::Display, ops::RangeBounds};

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use serde_json::Value;

/// Why settings were rejected: which key, its value, and what to do.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ConfigError(String);

impl ConfigError {
    /// An error that `value` cannot work for `key`, a path with its table. `why` says what is wrong and what to do.
    pub fn new(key: &str, value: impl Display, why: impl Display) -> Self {
        Self(format!("{key} = {value} cannot work: {why}"))
    }
}

/// Returns the error [`ConfigError::new`] unless `is_valid`.
pub fn check(
    is_valid: bool,
    key: &str,
    value: impl Display,
    why: impl Display,
) -> Result<(), ConfigError> {
    match is_valid {
        true => Ok(()),
        false => Err(ConfigError::new(key, value, why)),
    }
}

/// Returns the error [`ConfigError::new`] unless `value` lies in `range`.
pub fn check_range<T: PartialOrd + Display>(
    key: &str,
    value: T,
    range: impl RangeBounds<T>,
    why: impl Display,
) -> Result<(), ConfigError> {
    check(range.contains(&value), key, value, why)
}

/// Describes in one line what is wrong with a table, and at which of its keys. Words stand for the names of Rust's types.
pub fn describe(error: &toml::de::Error) -> String {
    let text = error.to_string().trim_end().replace('\n', ", ");
    let Some((wrong, rest)) = text.split_once(", expected ") else {
        return text;
    };
    let (expected, place) = rest.split_at(rest.find(',').unwrap_or(rest.len()));
    let words = match expected {
        "u8" => "a whole number from 0 to 255",
        "u32" => "a whole number from 0 to 4294967295",
        "u64" | "usize" => "a whole number from 0",
        "f32" | "f64" => "a number",
        name if name.contains("struct ") || name.contains("tagged enum ") => "a table in { }",
        other => other,
    };
    format!("{wrong}, expected {words}{place}")
}

/// Finds the first value that differs. Returns its path, which starts with `name`, and both values.
pub fn first_difference(
    name: &str,
    one: &Value,
    other: &Value,
) -> Option<(String, String, String)> {
    if one == other {
        return None;
    }
    if let (Value::Object(ones), Value::Object(others)) = (one, other) {
        let keys = ones.keys().chain(others.keys());
        let at = |key: &String| first_difference(&format!("{name}.{key}"), &one[key], &other[key]);
        return keys.into_iter().find_map(at);
    }
    Some((name.into(), one.to_string(), other.to_string()))
}

/// The `[transport]` table: how messages are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransportConfig {
    /// Whether chunks and batches go through shared memory between processes on one host. Sockets carry everything else, messages between
    /// hosts, and messages that do not arrive through shared memory.
    pub shared_memory: bool,
}

/// The resolved settings of a run, with one table for each component.
#[derive(Clone, Debug)]
pub struct Settings(toml::Table);

impl Settings {
    /// Parses the settings from TOML.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let why = |e: toml::de::Error| ConfigError(format!("the settings are not valid TOML: {e}"));
        text.parse().map(Self).map_err(why)
    }

    /// Reads one table as type `T`, which rejects unknown keys, missing keys and wrong types.
    pub fn table<T: DeserializeOwned>(&self, name: &'static str) -> Result<T, ConfigError> {
        let missing = || {
            ConfigError(format!(
                "the settings have no [{name}] table: use a config.toml that driml wrote, or a preset"
            ))
        };
        let value = self.0.get(name).ok_or_else(missing)?;
        let why = |e: toml::de::Error| {
            ConfigError(format!("in the settings' [{name}] table: {}", describe(&e)))
        };
        value.clone().try_into().map_err(why)
    }
}
