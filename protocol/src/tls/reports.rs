//! What zenoh's log says of those whom it did not let in, in our words: it tells nobody else of them.
//! It logs nothing itself; whoever listens counts and logs, at a bounded rate.

use std::{
    cell::RefCell,
    collections::BTreeMap,
    sync::{Mutex, PoisonError, mpsc},
};

/// Where zenoh says that a handshake failed, in warnings.
pub const HANDSHAKE_TARGET: &str = "zenoh_link_commons::quic::unicast";
/// Where zenoh says that a message was denied, in traces.
pub const ACCESS_TARGET: &str = "zenoh::net::routing::interceptor::access_control";

/// Reports that wait for the listener; further ones are left out, which is the least of a flood's harm.
const WAITING_MAX: usize = 256;

static LISTENER: Mutex<Option<mpsc::SyncSender<Report>>> = Mutex::new(None);

/// Somebody, or a message, that was not let in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Report {
    /// A connection that was refused: why, and what to do.
    Connection(String),
    /// A message that the sender's role may not send: who, what, where.
    Message(String),
}

/// The reports from now on. There is one listener in a process, the newest.
pub fn listen() -> mpsc::Receiver<Report> {
    let (sender, receiver) = mpsc::sync_channel(WAITING_MAX);
    *LISTENER.lock().unwrap_or_else(PoisonError::into_inner) = Some(sender);
    receiver
}

/// Takes a line of zenoh's log at one of the two targets; it may be any.
pub fn overhear(target: &str, line: &str) {
    let report = match target {
        HANDSHAKE_TARGET => connection(line),
        ACCESS_TARGET => message(line),
        _ => None,
    };
    let Some(report) = report else { return };
    let listener = LISTENER.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(listener) = &*listener {
        // A listener that is behind counts fewer.
        let _ = listener.try_send(report);
    }
}

/// Why a handshake failed.
fn connection(line: &str) -> Option<Report> {
    // Zenoh adds to whatever went wrong a guess of its own.
    let (said, _) = line.split_once(" Hint: increase the system open file limit")?;
    let said = said.strip_prefix("QUIC acceptor failed: ")?;
    let why = if said.contains("peer sent no certificates") {
        "it has no certificate: start that part with --tls-dir, and deploy/certs.sh makes what it needs".into()
    } else if said.contains("UnknownIssuer") || said.contains("BadSignature") {
        "its certificate is of another authority than ca.pem here: make it with this authority, or copy ca.pem if it is the wrong one"
            .into()
    } else if said.contains("not valid yet") {
        "its certificate is not valid yet: the clock of this machine is wrong, or of the one on which it was made".into()
    } else if said.contains("expired") || said.contains("Expired") {
        "its certificate has expired: remove it and its key, and deploy/certs.sh makes new ones"
            .into()
    } else if said.contains("not valid for any extended key usage")
        || said.contains("InvalidPurpose")
        || said.contains("does not allow extended key usage")
    {
        "its certificate is a replay server's, which connects to nobody: each part has its own"
            .into()
    } else if said.contains("ConnectionClosed") && said.contains("crypto") {
        "it refuses this replay server's certificate: its own log says why".into()
    } else if said.contains("Closed") {
        // It gave up, as a part does that is told to end.
        return None;
    } else if said.contains("TimedOut") {
        "it began to connect and did not go on".into()
    } else {
        said.to_owned()
    };
    Some(Report::Connection(why))
}

thread_local! {
    /// The key for which this thread works out all permissions of one peer at once, and how many lines of it are still to come.
    /// Nothing was asked at this key yet.
    static WORKED_OUT: RefCell<(String, u8)> = const { RefCell::new((String::new(), 0)) };
}

/// Kinds of messages for which zenoh works out a permission.
const KINDS: u8 = 9;

/// Which message was denied, and to whom.
fn message(line: &str) -> Option<Report> {
    if let Some((_, key)) = line.split_once("caching permissions for `") {
        let key = key.split('`').next().unwrap_or_default().to_owned();
        WORKED_OUT.set((key, KINDS));
        return None;
    }
    if line.contains("did not match any configured ACL subject") {
        return Some(Report::Message(
            "somebody whose certificate names no role of this run may do nothing: deploy/certs.sh makes those that do".into(),
        ));
    }
    let (_, key) = line.rsplit_once(" on ")?;
    let is_asked = line.starts_with("Using cached result")
        || WORKED_OUT.with_borrow_mut(|(known, left)| {
            let is_worked_out = *left > 0 && known == key;
            *left = left.saturating_sub(1);
            !is_worked_out
        });
    // `ID on Interface(lo)+CertCommonName(actor-1)+...`, or of a permission that is looked up `Using cached result: ID`.
    let (who, what) = [" is unauthorized to ", " is authorized to "]
        .iter()
        .find_map(|verb| line.split_once(verb))?;
    let name = name_of(who);
    // What is not sent to somebody is no deed of theirs.
    if !is_asked || line.contains(" is authorized to ") || !what.contains("(ingress)") {
        return None;
    }
    let what = what.split(" (ingress)").next().unwrap_or(what);
    let deed = match what {
        "Query" => "ask",
        "Reply" | "Declare Queryable" => "answer",
        "Put" | "Delete" => "announce",
        "Declare Subscriber" => "listen",
        "Liveliness Token" => "be alive",
        other => other,
    };
    Some(Report::Message(format!(
        "{name} may not {deed} at {key}: its certificate is for another role or number"
    )))
}

/// Peers whose names are remembered, by zenoh's number of them; of further ones the name is not said each time.
const NAMES_MAX: usize = 4096;

static NAMES: Mutex<BTreeMap<String, String>> = Mutex::new(BTreeMap::new());

/// The name in the certificate of whoever a line is about.
fn name_of(who: &str) -> String {
    let mut names = NAMES.lock().unwrap_or_else(PoisonError::into_inner);
    let number = who.split(" on ").next().unwrap_or(who);
    let number = number.trim_start_matches("Using cached result: ");
    let named = who
        .split_once("CertCommonName(")
        .and_then(|(_, name)| name.split(')').next());
    match named {
        Some(name) => {
            if names.len() < NAMES_MAX && !names.contains_key(number) {
                names.insert(number.to_owned(), name.to_owned());
            }
            name.to_owned()
        }
        None => names
            .get(number)
            .map_or("a part", String::as_str)
            .to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_was_refused_is_reported() {
        let said = |line: &str| connection(line).map(|it| format!("{it:?}"));
        let failed = |why: &str| {
            let hint = "Hint: increase the system open file limit.";
            said(&format!("QUIC acceptor failed: {why} at /a/b.rs:1. {hint}"))
        };
        let no_certificate = failed("TransportError(\"peer sent no certificates\")").unwrap();
        assert!(no_certificate.contains("it has no certificate"));
        assert!(failed("TimedOut").unwrap().contains("did not go on"));
        let gave_up = "ConnectionClosed(ConnectionClose { error_code: APPLICATION_ERROR })";
        assert_eq!(failed(gave_up), None);
        assert_eq!(
            said("Can not accept QUIC connections: acceptor closed"),
            None
        );

        let denied = "1f on Interface(lo)+CertCommonName(actor-1)+Transport(Quic) is unauthorized to Query (ingress) on d/batch";
        let Some(Report::Message(text)) = message(denied) else {
            panic!("{denied}");
        };
        assert!(text.starts_with("actor-1 may not ask at d/batch"), "{text}");
        // Permissions for a key that was declared are worked out at once, and then looked up.
        assert_eq!(
            message("ACL (ingress): caching permissions for `d/batch` ..."),
            None
        );
        for _ in 0..KINDS {
            assert_eq!(message(denied), None);
        }
        let looked_up = "Using cached result: 1f is unauthorized to Query (ingress) on d/batch";
        let Some(Report::Message(text)) = message(looked_up) else {
            panic!("{looked_up}");
        };
        assert!(text.starts_with("actor-1 may not ask at d/batch"), "{text}");
        assert!(message(denied).is_some());
        for quiet in [
            "1f on x is authorized to Query (ingress) on driml/batch",
            "1f on x is unauthorized to Put (egress) on driml/weights-version",
        ] {
            assert_eq!(message(quiet), None, "{quiet}");
        }
    }
}
