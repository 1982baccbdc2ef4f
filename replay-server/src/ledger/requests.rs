//! Which rows each client was given last, so that those of a batch that did not arrive can be taken back.
//! It neither draws rows nor counts them.

use std::collections::VecDeque;

use driml_protocol::RequestId;

/// Clients that are remembered; a learner has one for each batch on its way, and nothing is taken back from one forgotten.
const CLIENTS_MAX: usize = 1024;

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
    /// Takes note of a request; the same one may come here any number of times until it is given rows. Gives the k of the rows that it
    /// was given by an earlier attempt and did not receive. `None`: it was answered already, or its client has sent it again or another
    /// since.
    pub(crate) fn begin(&mut self, id: RequestId) -> Option<Vec<u32>> {
        let mut last = self.last.iter();
        let known = last.position(|it| it.id.client_id == id.client_id);
        if known.is_some_and(|at| self.last[at].id == id && self.last[at].given.is_none()) {
            return Some(Vec::new());
        }
        let order = |id: RequestId| (id.number, id.attempt);
        let (request, lost) = match known.and_then(|at| self.last.remove(at)) {
            Some(known) if order(id) <= order(known.id) => (known, None),
            known => {
                let repeated = known.filter(|it| it.id.number == id.number);
                let lost = repeated.and_then(|it| it.given).unwrap_or_default();
                (Request { id, given: None }, Some(lost))
            }
        };
        if self.last.len() == CLIENTS_MAX {
            self.last.pop_front();
        }
        self.last.push_back(request);
        lost
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

    #[test]
    fn of_too_many_clients_the_one_heard_of_longest_ago_is_forgotten() {
        let mut requests = Requests::default();
        for client_id in 0..CLIENTS_MAX as u64 {
            requests.begin(RequestId::first(client_id));
            requests.complete(client_id, vec![1]);
        }
        let again = RequestId::first(0).again();
        assert_eq!(requests.begin(again), Some(vec![1]));
        requests.complete(0, vec![2]);
        requests.begin(RequestId::first(u64::MAX));
        assert_eq!(requests.last.len(), CLIENTS_MAX);
        assert_eq!(requests.begin(again.again()), Some(vec![2]));
        let forgotten = RequestId::first(1).again();
        assert_eq!(requests.begin(forgotten), Some(vec![]));
    }
}
