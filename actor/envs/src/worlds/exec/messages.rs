//! The three lines of JSON with which an actor and a world's process find out what they are to each other, and the one that says
//! where a state lies.

use serde::{Deserialize, Serialize};

use super::block::Layout;
use super::error::Fault;

/// The protocol's version. A process that speaks another is refused.
pub(super) const VERSION: u64 = 1;

/// Most characters of a line that a message repeats.
const SHOWN_MAX: usize = 200;

/// What an actor asks for.
#[derive(Debug, Serialize)]
pub(super) struct Request {
    driml_env: u64,
    copies: usize,
    seeds: Vec<u32>,
}

impl Request {
    pub(super) const fn new(seeds: Vec<u32>) -> Self {
        Self {
            driml_env: VERSION,
            copies: seeds.len(),
            seeds,
        }
    }
}

/// What a world is, by its own word.
#[derive(Debug, Deserialize)]
pub(super) struct Declaration {
    pub(super) copies: usize,
    pub(super) height: usize,
    pub(super) width: usize,
    pub(super) channels: usize,
    pub(super) actions: Vec<String>,
    /// Whether it knows how to save and to load its state. Worlds of before say nothing of it.
    #[serde(default)]
    pub(super) saves: bool,
}

impl Declaration {
    /// Reads the first line of a process.
    ///
    /// # Errors
    /// It is none, or of another version.
    pub(super) fn parse(line: &[u8]) -> Result<Self, Fault> {
        let no_world = |why: String| {
            let line = String::from_utf8_lossy(line);
            Fault::NoWorld {
                line: line.chars().take(SHOWN_MAX).collect(),
                why,
            }
        };
        let value: serde_json::Value =
            serde_json::from_slice(line).map_err(|e| no_world(e.to_string()))?;
        let found = value.get("driml_env").and_then(serde_json::Value::as_u64);
        match found {
            Some(VERSION) => serde_json::from_value(value).map_err(|e| no_world(e.to_string())),
            Some(found) => Err(Fault::Version {
                found,
                known: VERSION,
            }),
            None => Err(no_world("\"driml_env\" is missing".into())),
        }
    }
}

/// Where the memory is that both sides share.
#[derive(Debug, Serialize)]
pub(super) struct Opening<'a> {
    pub(super) block: &'a str,
    #[serde(flatten)]
    pub(super) layout: Layout,
}

/// Where a state is to be written, or lies.
#[derive(Debug, Serialize)]
pub(super) struct StatePlace<'a> {
    pub(super) state: &'a str,
    pub(super) bytes_max: u64,
}
