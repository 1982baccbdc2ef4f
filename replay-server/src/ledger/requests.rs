//! Which rows each asker was given last, so that those of a batch that did not arrive can be taken back.
//! It neither draws rows nor counts them.

use std::{cmp::Ordering, collections::VecDeque};

use driml_protocol::RequestId;

/// Askers that are remembered; a learner has one for each batch on its way, and nothing is taken back from one forgotten.
const ASKERS_MAX: usize = 1024;

/// What a request is, seen beside those of its asker that came before.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Standing {
    /// To be answered. It repeats one that was given rows with these k, and did not receive them; none if it does not.
    Open(Vec<u32>),
    /// Answered already, or its asker has sent it again or another since: nobody waits for it.
    Overtaken,
}

/// The last request of each asker, of the one heard of longest ago first.
#[derive(Default)]
pub(crate) struct Requests {
    last: VecDeque<Request>,
}

struct Request {
    id: RequestId,
    /// The k of each row that it was given; none before.
    given: Option<Vec<u32>>,
}

impl Requests {
    /// Takes note of a request; the same one may come here any number of times until it is given rows.
    pub(crate) fn enter(&mut self, id: RequestId) -> Standing {
        let known = self.last.iter().position(|it| it.id.asker == id.asker);
        let mut request = known
            .and_then(|at| self.last.remove(at))
            .unwrap_or(Request { id, given: None });
        let order = (id.number, id.attempt).cmp(&(request.id.number, request.id.attempt));
        let standing = match order {
            Ordering::Less => Standing::Overtaken,
            Ordering::Equal if request.given.is_some() => Standing::Overtaken,
            _ => {
                let given = request
                    .given
                    .take()
                    .filter(|_| request.id.number == id.number);
                request.id = id;
                Standing::Open(given.unwrap_or_default())
            }
        };
        if self.last.len() == ASKERS_MAX {
            self.last.pop_front();
        }
        self.last.push_back(request);
        standing
    }

    /// The request of this asker that was entered last is given rows with these `ks`.
    pub(crate) fn give(&mut self, asker: u64, ks: Vec<u32>) {
        if let Some(request) = self.last.iter_mut().find(|it| it.id.asker == asker) {
            request.given = Some(ks);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(ks: &[u32]) -> Standing {
        Standing::Open(ks.to_vec())
    }

    #[test]
    fn what_did_not_arrive_is_told_once() {
        let mut requests = Requests::default();
        let first = RequestId::first(7);
        assert_eq!(requests.enter(first), open(&[]));
        assert_eq!(requests.enter(first), open(&[]), "it still waits");
        requests.give(7, vec![1, 2]);
        assert_eq!(
            requests.enter(first),
            Standing::Overtaken,
            "it was answered"
        );
        assert_eq!(requests.enter(first.again()), open(&[1, 2]));
        assert_eq!(
            requests.enter(first.again()),
            open(&[]),
            "taken back before"
        );
        assert_eq!(requests.enter(first), Standing::Overtaken);
        requests.give(7, vec![3]);
        let second = first.again().next();
        assert_eq!(requests.enter(second), open(&[]), "the first one arrived");
        assert_eq!(requests.enter(first.again().again()), Standing::Overtaken);
        assert_eq!(requests.enter(RequestId::first(8)), open(&[]));
    }

    #[test]
    fn of_too_many_askers_the_one_heard_of_longest_ago_is_forgotten() {
        let mut requests = Requests::default();
        for asker in 0..ASKERS_MAX as u64 {
            requests.enter(RequestId::first(asker));
            requests.give(asker, vec![1]);
        }
        assert_eq!(requests.enter(RequestId::first(0).again()), open(&[1]));
        requests.give(0, vec![2]);
        requests.enter(RequestId::first(u64::MAX));
        assert_eq!(requests.last.len(), ASKERS_MAX);
        assert_eq!(
            requests.enter(RequestId::first(0).again().again()),
            open(&[2])
        );
        assert_eq!(
            requests.enter(RequestId::first(1).again()),
            open(&[]),
            "forgotten"
        );
    }
}
