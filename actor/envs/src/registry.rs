//! The names of worlds on a command line, and their settings by kind: of the menu in `worlds`, and of those that a program registers.
//! It holds no numbers: each world's settings are described beside that world.

use std::collections::BTreeSet;
use std::fmt;
use std::ops::Deref;
use std::str::FromStr;
use std::sync::{Mutex, PoisonError};

use serde::de::Error;
use serde::{Deserialize, Deserializer};
use toml::Table;

use crate::error::{EnvError, require};
use crate::plugin::{self, CustomWorld};
use crate::restricted::ActionSet;
use crate::settings::{Variants, WorldSettings};
use crate::worlds::{KIND_NAMES, KINDS, WorldConfig, procgen::ProcgenConfig};

/// The prefix of `libenv:PATH:GAME`: one of Procgen's games, run by another build of its library.
const LIBENV_PREFIX: &str = "libenv";

/// The kind of world whose games `libenv:PATH:GAME` names.
const LIBENV_KIND: &str = "procgen";

impl<'de> Deserialize<'de> for WorldConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let table = Table::deserialize(deserializer)?;
        let mut fields = table.clone();
        let kind = fields.remove("kind");
        let kind = kind.ok_or_else(|| D::Error::missing_field("kind"))?;
        // Two lines: what is wrong, and at which key.
        let in_one_line = |e: toml::de::Error| e.to_string().trim_end().replace('\n', ", ");
        let invalid = |e: toml::de::Error| D::Error::custom(in_one_line(e));
        let kind: String = kind.try_into().map_err(invalid)?;
        if let Some(built_in) = Self::parse_built_in(&kind, &fields) {
            return built_in.map_err(invalid);
        }
        let custom = CustomWorld::parse(&kind, fields, table);
        let custom = custom.ok_or_else(|| D::Error::unknown_variant(&kind, KIND_NAMES))?;
        custom.map(Self::Custom).map_err(D::Error::custom)
    }
}

impl WorldConfig {
    /// The world's name on a command line.
    pub fn name(&self) -> WorldName {
        let (kind, settings) = self.settings();
        WorldName {
            kind,
            variant: settings.variant().map(intern),
            library: settings.library().map(intern),
        }
    }

    /// The number of the world's actions; valid actions are `0..num_actions`.
    pub fn num_actions(&self) -> usize {
        self.action_names().len()
    }

    /// Returns the actions of `set`, ascending; each is an index into [`action_names`](WorldSettings::action_names).
    pub fn actions(&self, set: ActionSet) -> Vec<u8> {
        let mut actions = match set {
            ActionSet::All => (0..self.num_actions()).map(|action| action as u8).collect(),
            ActionSet::Visible => self.visible_actions(),
        };
        actions.sort_unstable();
        actions.dedup();
        actions
    }

    /// Returns the same world with one level of training per episode.
    ///
    /// # Errors
    /// The world has no levels; the message says what to use instead.
    pub fn with_single_levels(&self) -> Result<Self, EnvError> {
        Ok(Self::Procgen(self.procgen()?.with_single_levels()))
    }

    /// Returns the same world with one level per episode that training has not seen.
    ///
    /// # Errors
    /// As [`with_single_levels`](Self::with_single_levels); also if training has seen all levels.
    pub fn with_unseen_levels(&self) -> Result<Self, EnvError> {
        self.procgen()?.with_unseen_levels().map(Self::Procgen)
    }

    fn procgen(&self) -> Result<&ProcgenConfig, EnvError> {
        let why = "this run's world has no levels: use --levels train";
        match self {
            Self::Procgen(config) => Ok(config),
            _ => Err(EnvError::Config(why.into())),
        }
    }

    /// Returns the same world with the command or the library of `name`, if the world has code outside this program.
    /// This machine may have that code in another place than the machine on which the run was made.
    pub fn with_code_of(&self, name: WorldName) -> Result<Self, EnvError> {
        let mut changed = self.clone();
        match &mut changed {
            Self::Exec(config) if let Some(command) = name.command() => {
                config.command = command.to_owned();
            }
            Self::Procgen(config) if let Some(library) = name.library() => {
                config.library = Some(library.to_owned());
            }
            _ => {}
        }
        let why = format!("the run's world is {}, and not {name}", self.name());
        require(changed.name() == name, why)?;
        Ok(changed)
    }
}

/// Gives access to the world's [`WorldSettings`]: what a run must know of the world, and how to build it.
impl Deref for WorldConfig {
    type Target = dyn WorldSettings;

    fn deref(&self) -> &Self::Target {
        self.settings().1
    }
}

/// A world's name on a command line: its kind and, after a colon, its variant if it has one. Other settings are not part of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct WorldName {
    kind: &'static str,
    variant: Option<&'static str>,
    /// The path of the library that is loaded instead of the world's own.
    library: Option<&'static str>,
}

/// Leaks a text that the user chose, so that [`WorldName`] is small and `Copy`. A run has one or two such texts; equal ones are shared.
fn intern(text: &str) -> &'static str {
    static INTERNED: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());
    let mut texts = INTERNED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(known) = texts.get(text) {
        return known;
    }
    let new: &'static str = Box::leak(text.into());
    texts.insert(new);
    new
}

impl WorldName {
    /// All names without a text that the user chooses: each of Procgen's games, then the other worlds, then the registered ones.
    pub fn all() -> impl Iterator<Item = WorldName> {
        let ours = KINDS.iter().flat_map(|(kind, variants)| {
            let all = variants();
            let bare = (all.names.is_empty() && !all.is_free_text).then_some(None);
            let variants = bare.into_iter().chain(all.names.iter().copied().map(Some));
            variants.map(|variant| Self::new(kind, variant))
        });
        ours.chain(plugin::registered_names().map(|kind| Self::new(kind, None)))
    }

    const fn new(kind: &'static str, variant: Option<&'static str>) -> Self {
        Self {
            kind,
            variant,
            library: None,
        }
    }

    /// Reads a name with a text that the user chooses, such as a command or the path of a library.
    fn parse_free_text(text: &str) -> Option<Self> {
        let (first, rest) = text.split_once(':')?;
        if first == LIBENV_PREFIX {
            let (library, game) = rest.rsplit_once(':')?;
            let known = Self::all().find(|it| it.kind == LIBENV_KIND && it.variant == Some(game));
            return known.filter(|_| !library.is_empty()).map(|known| Self {
                library: Some(intern(library)),
                ..known
            });
        }
        let (kind, _) = KINDS
            .iter()
            .find(|(kind, variants)| *kind == first && variants().is_free_text)?;
        (!rest.trim().is_empty()).then(|| Self::new(kind, Some(intern(rest))))
    }

    /// The command that starts the world, if the world runs in its own process.
    pub fn command(self) -> Option<&'static str> {
        self.variant.filter(|_| self.variants().is_free_text)
    }

    fn variants(self) -> Variants {
        let known = KINDS.iter().find(|(kind, _)| *kind == self.kind);
        known.map(|(_, variants)| variants()).unwrap_or_default()
    }

    /// The world's code outside this program: a command, or a library by its path.
    pub fn foreign_code(self) -> Option<&'static str> {
        self.command().or(self.library)
    }

    /// Returns the same world with its own engine: what is known of it also holds for other builds.
    pub const fn without_library(self) -> Self {
        Self {
            library: None,
            ..self
        }
    }

    /// The path of the library that is loaded instead of the world's own, if any.
    pub const fn library(self) -> Option<&'static str> {
        self.library
    }

    /// The world's `kind` in a settings file.
    pub const fn kind(self) -> &'static str {
        self.kind
    }

    /// The settings, with their values, that select this world among those of its kind.
    pub fn settings(self) -> impl Iterator<Item = (&'static str, &'static str)> {
        let variant = self.variant.map(|name| (self.variants().key, name));
        let library = self.library.map(|path| ("library", path));
        variant.into_iter().chain(library)
    }
}

impl fmt::Display for WorldName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.library {
            Some(library) => write!(f, "{LIBENV_PREFIX}:{library}")?,
            None => f.write_str(self.kind)?,
        }
        self.variant.map_or(Ok(()), |name| write!(f, ":{name}"))
    }
}

impl FromStr for WorldName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let known = WorldName::all().find(|name| name.to_string() == text);
        let known = known.or_else(|| WorldName::parse_free_text(text));
        known.ok_or_else(|| unknown_name_error(text))
    }
}

/// The error for a text that names no world. It lists all worlds and suggests the nearest if one is near.
fn unknown_name_error(text: &str) -> String {
    let mut why = format!("no world is named \"{text}\"");
    if let Some(name) = nearest_world(text) {
        why += &format!("; did you mean \"{name}\"?");
    }
    if is_gymnasium_name(text) {
        let flags = match text.starts_with("ALE/") {
            true => "--atari",
            false => "--pixels --size 64 --grey",
        };
        why += &format!(
            "; a world of Gymnasium is \"exec:python3 deploy/python/driml_env.py {text} {flags}\", \
             and deploy/docs/src/how-to/own-world.md says what that needs"
        );
    }
    let (mut names, mut listed) = (Vec::new(), String::new());
    for (kind, variants) in KINDS {
        let variants = variants();
        if variants.key.is_empty() {
            names.push((*kind).to_owned());
            continue;
        }
        let key = variants.key.to_uppercase();
        names.push(format!("{kind}:{key}"));
        if !variants.names.is_empty() {
            listed += &format!("; {key} is one of {}", variants.names.join(", "));
        }
    }
    names.push(format!("{LIBENV_PREFIX}:PATH:GAME"));
    names.extend(plugin::registered_names().map(str::to_owned));
    format!("{why} (the worlds: {}{listed})", names.join(", "))
}

/// Whether a name has the form of Gymnasium's names: `ALE/Pong-v5`, `CartPole-v1`.
fn is_gymnasium_name(text: &str) -> bool {
    let version = text.rsplit_once("-v").map(|(_, version)| version);
    let has_version =
        version.is_some_and(|it| !it.is_empty() && it.bytes().all(|it| it.is_ascii_digit()));
    !text.contains(':') && (has_version || text.contains('/'))
}

/// Returns the world whose name is nearest to `text`: at most 3 edits, and a third of its letters, away. `text` may lack the kind.
fn nearest_world(text: &str) -> Option<WorldName> {
    let letters = |text: &str| -> String { text.chars().filter(|c| c.is_alphanumeric()).collect() };
    let text = letters(&text.to_lowercase());
    let distance = |name: WorldName| {
        let full = strsim::osa_distance(&text, &letters(&name.to_string()));
        name.variant.map_or(full, |variant| {
            full.min(strsim::osa_distance(&text, variant))
        })
    };
    let name = WorldName::all().min_by_key(|&name| distance(name))?;
    // Three edits may replace most of a short name: pong is not ising.
    let distance_max = (text.chars().count() / 3).min(3);
    (distance(name) <= distance_max).then_some(name)
}

#[cfg(test)]
mod tests;
