//! How a process finds its own tables in the run's resolved settings, and how it says that a value cannot work.
//! It does not know what the tables hold: each crate has its Config.

use std::fmt::Display;

use serde::{Deserialize, Serialize, de::DeserializeOwned};

/// Why settings were refused: which, what they are, and what to do.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ConfigError(String);

impl ConfigError {
    /// The value of a key, which is a path with its table, cannot work; `why` says what is wrong and what to do.
    pub fn of(key: &str, value: impl Display, why: impl Display) -> Self {
        Self(format!("{key} = {value} cannot work: {why}"))
    }
}

/// Checks what must be so for the value of a key; if it is not, that is a [`ConfigError::of`] it.
pub fn check<W: Display>(
    is_so: bool,
    key: &str,
    value: impl Display,
    why: impl FnOnce() -> W,
) -> Result<(), ConfigError> {
    match is_so {
        true => Ok(()),
        false => Err(ConfigError::of(key, value, why())),
    }
}

/// What is wrong with a table, and at which of its keys, in one line.
pub fn describe(error: &toml::de::Error) -> String {
    error.to_string().trim_end().replace('\n', ", ")
}

/// The `[transport]` table: how messages travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransportConfig {
    /// Whether chunks and batches go through shared memory between processes on one host. Everything else goes through sockets, and
    /// so does what goes to another host or does not arrive.
    pub shared_memory: bool,
}

/// The resolved settings of a run, one table a component.
#[derive(Clone, Debug)]
pub struct Settings(toml::Table);

impl Settings {
    /// Parses the settings, which are TOML.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let why = |e: toml::de::Error| ConfigError(format!("the settings are not valid TOML: {e}"));
        text.parse().map(Self).map_err(why)
    }

    /// Reads one table; unknown keys, missing keys and wrong types are refused by the type.
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
