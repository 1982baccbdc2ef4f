//! Where the processes of a run meet: endpoints that zenoh can open, and the prefix of the run's keys.
//! It opens nothing.

use driml_machine::error::{Usage, usage};

/// The prefix of a run's keys unless it is told otherwise.
pub const NAMESPACE: &str = "driml";

/// Refuses what zenoh could not open.
pub fn check_endpoints(endpoints: &[String]) -> Result<(), Usage> {
    let good = |endpoint: &str| match endpoint.split_once('/') {
        Some(("tcp" | "tls", address)) => address
            .rsplit_once(':')
            .is_some_and(|(host, _)| !host.is_empty()),
        Some(("unixsock-stream", path)) => !path.is_empty(),
        _ => false,
    };
    match endpoints.iter().find(|endpoint| !good(endpoint)) {
        Some(endpoint) => Err(usage!(
            "{endpoint:?} is no endpoint: take tcp/HOST:PORT, tls/HOST:PORT or unixsock-stream/PATH"
        )),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_that_zenoh_cannot_open_are_refused() {
        for good in [
            "tcp/127.0.0.1:7447",
            "tcp/[::1]:7447",
            "tls/host:1",
            "unixsock-stream//tmp/driml.sock",
        ] {
            assert!(check_endpoints(&[good.into()]).is_ok(), "{good}");
        }
        for bad in [
            "",
            "localhost:7447",
            "tcp/localhost",
            "tcp/:1",
            "udp/1.2.3.4:5",
            "unixsock-stream/",
        ] {
            assert!(check_endpoints(&[bad.into()]).is_err(), "{bad}");
        }
    }
}
