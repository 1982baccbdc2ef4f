//! Worlds that a program adds to those of this crate. It registers them before anything else; from then on their names are known.
//! The same program starts every process of a run, so that all processes know these worlds.

use std::fmt;
use std::sync::{Arc, OnceLock};

use serde::Serialize;
use serde::de::DeserializeOwned;
use toml::Table;

use crate::settings::WorldSettings;

/// The settings of any world, behind a shared pointer.
type Settings = Arc<dyn WorldSettings + Send + Sync>;

/// A kind of world that a program adds.
#[derive(Debug)]
pub struct CustomKind {
    name: &'static str,
    preset: &'static str,
    parse: fn(Table) -> Result<Settings, toml::de::Error>,
}

static REGISTERED: OnceLock<Vec<CustomKind>> = OnceLock::new();

impl CustomKind {
    /// Creates a kind of world: `--env NAME` trains in it, and the settings of `kind = "NAME"` are read as an `S`.
    ///
    /// `preset` is the world's layer of settings, TOML as in `deploy/settings/presets/world/`: at least `run.frame_stack`,
    /// `input.height`, `input.width` and the table `[world]` with the fields of `S`. A name of one of this crate's
    /// worlds keeps its meaning. If two kinds have the same name, the first counts.
    pub fn new<S>(name: &'static str, preset: &'static str) -> Self
    where
        S: WorldSettings + DeserializeOwned + Send + Sync + 'static,
    {
        Self {
            name,
            preset,
            parse: |table| Ok(Arc::new(table.try_into::<S>()?)),
        }
    }
}

/// Registers these worlds.
///
/// # Panics
/// If it was called before.
pub fn register(kinds: Vec<CustomKind>) {
    let result = REGISTERED.set(kinds);
    result.expect("a program registers its worlds once");
}

fn registered() -> &'static [CustomKind] {
    REGISTERED.get().map_or(&[], Vec::as_slice)
}

pub(crate) fn registered_names() -> impl Iterator<Item = &'static str> {
    registered().iter().map(|kind| kind.name)
}

/// Returns the layer of settings (TOML) of a registered world.
pub fn preset(name: &str) -> Option<&'static str> {
    let kind = registered().iter().find(|kind| kind.name == name);
    kind.map(|kind| kind.preset)
}

/// The settings of a registered world: the table as read, and the world's settings made from it.
#[derive(Clone, Serialize)]
#[serde(transparent)]
pub struct CustomWorld {
    #[serde(skip)]
    kind: &'static str,
    /// The table, with `kind`, so that the settings are written as they were read.
    table: Table,
    #[serde(skip)]
    settings: Settings,
}

impl CustomWorld {
    /// Reads the settings of a registered world. `table` holds `kind` and the `fields`. Returns `None` if `kind` is not registered.
    pub(crate) fn parse(
        kind: &str,
        fields: Table,
        table: Table,
    ) -> Option<Result<Self, toml::de::Error>> {
        let kind = registered().iter().find(|it| it.name == kind)?;
        let settings = (kind.parse)(fields);
        Some(settings.map(|settings| Self {
            kind: kind.name,
            table,
            settings,
        }))
    }

    pub(crate) const fn kind(&self) -> &'static str {
        self.kind
    }

    pub(crate) fn settings(&self) -> &(dyn WorldSettings + 'static) {
        self.settings.as_ref()
    }
}

impl fmt::Debug for CustomWorld {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.table.fmt(f)
    }
}

impl PartialEq for CustomWorld {
    fn eq(&self, other: &Self) -> bool {
        self.table == other.table
    }
}
