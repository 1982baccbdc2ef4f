//! Which rows each client was given last, so that those of a batch that did not arrive can be taken back.
//! It neither draws rows nor counts them.

use std::{cmp::Ordering, collections::VecDeque};

use driml_protocol::RequestId;

/// Clients that are remembered; a learner has one for each batch on its way, and nothing is taken back from one forgotten.
const CLIENTS_MAX: usize = 1024;

/// What a request is, seen beside those of its client that came before.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Dedup {
    /// To be answered. It repeats one that was given rows with these k, and did not receive them; none if it does not.
    Fresh(Vec<u32>),
    /// Answered already, or its client has sent it again or another since: it was given up.
    Superseded,
}

/// The last request of each client, of the one whose request is oldest first.
#[derive(Clone, Debug, Default)]
pub(crate) struct Requests {
    last: VecDeque<Request>,
}

#[derive(Clone, Debug)]
struct Request {
    id: RequestId,
    /// The k of each row that it was given; none before.
    given: Option<Vec<u32>>,
}

impl Requests {
    /// Takes note of a request; the same one may come here any number of times until it is given rows.
    pub(crate) fn begin(&mut self, id: RequestId) -> Dedup {
        let mut last = self.last.iter();
        let known = last.position(|it| it.id.client_id == id.client_id);
        if known.is_some_and(|at| self.last[at].id == id && self.last[at].given.is_none()) {
            return Dedup::Fresh(Vec::new());
        }
        let mut request = known
            .and_then(|at| self.last.remove(at))
            .unwrap_or(Request { id, given: None });
        let order = (id.number, id.attempt).cmp(&(request.id.number, request.id.attempt));
        let dedup = match order {
            Ordering::Less => Dedup::Superseded,
            Ordering::Equal if request.given.is_some() => Dedup::Superseded,
            _ => {
                let given = request
                    .given
                    .take()
                    .filter(|_| request.id.number == id.number);
                request.id = id;
                Dedup::Fresh(given.unwrap_or_default())
            }
        };
        if self.last.len() == CLIENTS_MAX {
            self.last.pop_front();
        }
        self.last.push_back(request);
        dedup
    }

    /// The request of this client that was begun last is given rows with these `ks`.
    pub(crate) fn complete(&mut self, client_id: u64, ks: Vec<u32>) {
        if let Some(request) = self.last.iter_mut().find(|it| it.id.client_id == client_id) {
            request.given = Some(ks);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fresh(ks: &[u32]) -> Dedup {
        Dedup::Fresh(ks.to_vec())
    }

    #[test]
    fn what_did_not_arrive_is_told_once() {
        let mut requests = Requests::default();
        let first = RequestId::first(7);
        let again = first.again();
        let other = RequestId::first(8);
        let cases = [
            (first, fresh(&[]), None, "the first"),
            (first, fresh(&[]), Some(vec![1, 2]), "it still waits"),
            (first, Dedup::Superseded, None, "it was answered"),
            (again, fresh(&[1, 2]), None, "the answer did not arrive"),
            (again, fresh(&[]), None, "taken back before"),
            (first, Dedup::Superseded, Some(vec![3]), "given up"),
            (again.next(), fresh(&[]), None, "the one before arrived"),
            (again.again(), Dedup::Superseded, None, "given up"),
            (other, fresh(&[]), None, "another client"),
        ];
        for (id, expected, given, what) in cases {
            assert_eq!(requests.begin(id), expected, "{what}");
            if let Some(ks) = given {
                requests.complete(id.client_id, ks);
            }
        }
    }

    #[test]
    fn of_too_many_clients_the_one_heard_of_longest_ago_is_forgotten() {
        let mut requests = Requests::default();
        for client_id in 0..CLIENTS_MAX as u64 {
            requests.begin(RequestId::first(client_id));
            requests.complete(client_id, vec![1]);
        }
        let again = RequestId::first(0).again();
        assert_eq!(requests.begin(again), fresh(&[1]));
        requests.complete(0, vec![2]);
        requests.begin(RequestId::first(u64::MAX));
        assert_eq!(requests.last.len(), CLIENTS_MAX);
        assert_eq!(requests.begin(again.again()), fresh(&[2]));
        let forgotten = RequestId::first(1).again();
        assert_eq!(requests.begin(forgotten), fresh(&[]));
    }
}
