//! The certificates in a folder for `--tls-dir`: which roles have one, which are valid, and what to do about the others.
//! This module makes no certificates: `deploy/certs.sh` does.

use std::{collections::BTreeSet, fs, path::Path};

use driml_protocol::tls::{self, Credentials, Role};

use super::fact::{Fact, State};
use crate::units::count;

const DAY_S: u64 = 24 * 3600;

/// The facts about `folder`: one for each process that has a file there, and a single one for all actors without a complaint.
pub(super) fn facts(folder: &Path) -> Vec<Fact> {
    let dir = folder.display();
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(e) => {
            let found = State::Missing.with(format!(
                "{dir} cannot be read ({e}): `deploy/certs.sh {dir}` makes the certificates"
            ));
            return vec![Fact::new("tls folder", found)];
        }
    };
    // A certificate or a key alone counts too: the other file is then reported as missing.
    let name = |entry: fs::DirEntry| {
        let path = entry.path();
        let extension = path.extension();
        let is_tls_file = extension.is_some_and(|it| it == "pem" || it == "key");
        let name = path.file_stem().filter(|it| is_tls_file && *it != "ca")?;
        name.to_str().map(str::to_owned)
    };
    let names: BTreeSet<_> = entries.flatten().filter_map(name).collect();
    let (mut facts, mut roles) = (Vec::new(), BTreeSet::new());
    let mut add =
        |what: &str, state: State, text: String| facts.push(Fact::new(what, state.with(text)));
    for name in &names {
        match name.parse::<Role>() {
            Ok(role) => _ = roles.insert(role),
            Err(e) => add("tls other", State::Note, format!("{dir}/{name}.*: {e}")),
        }
    }
    if roles.is_empty() {
        let text = format!("{dir} has no certificates: `deploy/certs.sh {dir}` makes them");
        add("tls folder", State::Missing, text);
    }
    let mut actors = Vec::new();
    for role in roles {
        let what = format!("tls {role}");
        match Credentials::read(folder, role) {
            Err(e) => add(&what, State::Missing, e.to_string()),
            Ok(it) => match (it.advice(), role) {
                (Some(text), _) => add(&what, State::Note, text),
                (None, Role::Actor(number)) => actors.push((number, it)),
                (None, Role::ReplayServer) => {
                    let (until, names) = (validity(&it), it.hosts.join(", "));
                    let text = format!("{until}, for {names}: connect to one of these names");
                    add(&what, State::Ok, text);
                }
                (None, _) => add(&what, State::Ok, validity(&it)),
            },
        }
    }
    if let Some(text) = describe_valid_actors(&actors) {
        add("tls actors", State::Ok, text);
    }
    // The authority's certificate is checked with each process's certificate.
    let key = tls::authority_path(folder).with_extension("key");
    if key.exists() {
        let text = format!(
            "{} can sign any certificate: keep it on the machine that made it alone",
            key.display()
        );
        add("tls authority", State::Note, text);
    }
    facts
}

fn validity(credentials: &Credentials) -> String {
    let days = count(credentials.expires_in().as_secs() / DAY_S, "day");
    format!("valid until {} ({days})", credentials.expires_on)
}

/// One text for all actors that have no complaint.
fn describe_valid_actors(actors: &[(u32, Credentials)]) -> Option<String> {
    let (first, last) = (actors.first()?.0, actors.last()?.0);
    let (_, soonest) = actors.iter().min_by_key(|(_, it)| it.expires_in())?;
    let until = validity(soonest);
    Some(match actors.len() {
        1 => format!("{first}: {until}"),
        count => format!("{count}, from {first} to {last}: {until}"),
    })
}
