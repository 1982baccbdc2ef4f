//! How a process finds its own tables in the run's resolved settings.
//! It does not know what the tables hold: each crate has its Config.

use serde::{Deserialize, Serialize, de::DeserializeOwned};

/// Why settings were refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The text is not TOML.
    #[error("the settings are not valid TOML: {0}")]
    Syntax(String),
    /// A table is missing.
    #[error("the settings have no [{0}] table: use a config.toml that driml wrote, or a preset")]
    Missing(&'static str),
    /// A table does not fit.
    #[error("in the settings' [{table}] table: {why}")]
    Table {
        /// The table's name.
        table: &'static str,
        /// What is wrong.
        why: String,
    },
}

/// What is wrong with a table, and at which of its keys, in one line.
pub fn in_words(error: &toml::de::Error) -> String {
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
    ///
    /// # Errors
    /// Text that is not TOML.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let table = text
            .parse::<toml::Table>()
            .map_err(|e| ConfigError::Syntax(e.to_string()))?;
        Ok(Self(table))
    }

    /// Reads one table; unknown keys, missing keys and wrong types are refused by the type.
    ///
    /// # Errors
    /// No such table, or one that does not fit `T`.
    pub fn table<T: DeserializeOwned>(&self, name: &'static str) -> Result<T, ConfigError> {
        let value = self.0.get(name).ok_or(ConfigError::Missing(name))?;
        let why = |e: toml::de::Error| ConfigError::Table {
            table: name,
            why: in_words(&e),
        };
        value.clone().try_into().map_err(why)
    }
}
