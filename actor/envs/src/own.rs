//! Worlds that a program adds to those of this crate: registered before anything else is done, known by name from then on.
//! They come from the same program that starts every process, so that all processes know them.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use serde::de::DeserializeOwned;
use serde::{Serialize, Serializer};
use toml::{Table, Value};

use crate::settings::WorldSettings;

/// Settings of any world, shared by those who read them.
type Settings = Arc<dyn WorldSettings + Send + Sync>;

/// A world that a program added.
#[derive(Clone, Copy)]
struct OwnKind {
    preset: &'static str,
    read: fn(Table) -> Result<Settings, toml::de::Error>,
}

static OWN: Mutex<BTreeMap<&'static str, OwnKind>> = Mutex::new(BTreeMap::new());

/// Makes a world known under the name `kind`: `--env KIND` trains in it, and `kind = "KIND"` in settings is read as an `S`.
///
/// `preset` is the world's layer of settings, TOML as in `deploy/settings/presets/world/`: at least `run.frame_stack`,
/// `input.height`, `input.width` and the table `[world]` with the fields of `S`. A name that this crate's worlds have stays theirs,
/// and of two registered under one name the later one counts.
pub fn register<S>(kind: &'static str, preset: &'static str)
where
    S: WorldSettings + DeserializeOwned + Send + Sync + 'static,
{
    let own = OwnKind {
        preset,
        read: |table| Ok(Arc::new(table.try_into::<S>()?)),
    };
    let mut all = OWN.lock().unwrap_or_else(PoisonError::into_inner);
    all.insert(kind, own);
}

/// The names of all worlds that were registered.
pub(crate) fn kinds() -> Vec<&'static str> {
    let all = OWN.lock().unwrap_or_else(PoisonError::into_inner);
    all.keys().copied().collect()
}

/// The layer of settings of a registered world.
pub fn preset(kind: &str) -> Option<&'static str> {
    let all = OWN.lock().unwrap_or_else(PoisonError::into_inner);
    all.get(kind).map(|own| own.preset)
}

/// The settings of a world that a program added: as they were read, and what its code made of them.
#[derive(Clone)]
pub struct OwnWorld {
    kind: &'static str,
    /// With `kind`, so that they are written as they were read.
    table: Table,
    settings: Settings,
}

impl OwnWorld {
    /// Reads the settings of a registered world; `None` if its `kind` is not registered.
    pub(crate) fn read(table: &Table) -> Option<Result<Self, toml::de::Error>> {
        let name = table.get("kind").and_then(Value::as_str)?;
        let found = {
            let all = OWN.lock().unwrap_or_else(PoisonError::into_inner);
            all.get_key_value(name).map(|(kind, own)| (*kind, *own))
        };
        let (kind, own) = found?;
        let mut fields = table.clone();
        fields.remove("kind");
        let settings = (own.read)(fields);
        Some(settings.map(|settings| Self {
            kind,
            table: table.clone(),
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

impl std::fmt::Debug for OwnWorld {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.table.fmt(f)
    }
}

impl PartialEq for OwnWorld {
    fn eq(&self, other: &Self) -> bool {
        self.table == other.table
    }
}

impl Serialize for OwnWorld {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.table.serialize(serializer)
    }
}
