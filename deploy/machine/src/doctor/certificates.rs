//! The certificates in a folder for `--tls-dir`: which roles have one, which are valid, and what to do about the others.
//! This module makes no certificates: `deploy/certs.sh` does.

use std::{collections::BTreeSet, fs, path::Path, time::Duration};

use driml_protocol::tls::{self, Credentials, Role};

use super::fact::{Fact, State};
use crate::units::count;

/// A certificate that expires within this time gets the state `Note`.
const EXPIRES_SOON: Duration = Duration::from_secs(30 * 24 * 3600);
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
    let (mut facts, mut roles) = (Vec::new(), Vec::new());
    let mut add =
        |what: &str, state: State, text: String| facts.push(Fact::new(what, state.with(text)));
    for name in &names {
        match name.parse::<Role>() {
            Ok(role) => roles.push(role),
            Err(e) => add("tls other", State::Note, format!("{dir}/{name}.*: {e}")),
        }
    }
    if roles.is_empty() {
        let text = format!("{dir} has no certificates: `deploy/certs.sh {dir}` makes them");
        add("tls folder", State::Missing, text);
    }
    roles.sort_by_key(|role| match role {
        Role::ReplayServer => (0, 0),
        Role::Learner => (1, 0),
        Role::Observer => (2, 0),
        Role::Actor(number) => (3, *number),
    });
    let mut actors = Vec::new();
    for role in roles {
        let what = format!("tls {role}");
        match Credentials::read_quietly(folder, role) {
            Err(e) => add(&what, State::Missing, e.to_string()),
            Ok(it) => match (advice(&it), role) {
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

/// What the user should do about a certificate that is valid; none if nothing.
fn advice(credentials: &Credentials) -> Option<String> {
    let (role, key) = (credentials.role, credentials.key.display());
    let left = credentials.expires_in();
    if credentials.is_key_exposed() {
        Some(format!(
            "{key} can be read by other users of this machine, who could take this role: chmod 600 {key}"
        ))
    } else if left < EXPIRES_SOON {
        Some(format!(
            "valid for {} more, then its process is disconnected: remove {role}.pem and {role}.key, let deploy/certs.sh make new ones, and \
             restart that process",
            count(left.as_secs() / DAY_S, "day")
        ))
    } else if role == Role::ReplayServer && credentials.hosts.is_empty() {
        Some(format!(
            "it names no host, so no client can connect: remove {role}.pem and {role}.key, and `deploy/certs.sh DIR --host \
             NAME_OR_ADDRESS` makes one"
        ))
    } else {
        None
    }
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
