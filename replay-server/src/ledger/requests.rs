//! The rows that each client was given last, so that the rows of a batch that did not arrive can be refunded.
//! It neither draws rows nor counts them.

use std::collections::VecDeque;

use driml_protocol::RequestId;

/// Maximum clients remembered. A learner uses one client per batch in flight. Rows of a forgotten client are not refunded.
const CLIENTS_MAX: usize = 1024;

/// The last request of each client, the oldest request first.
#[derive(Clone, Debug, Default)]
pub(crate) struct LastRequests {
    last: VecDeque<Request>,
}

#[derive(Clone, Debug)]
struct Request {
    id: RequestId,
    /// The k of each row that the request was given; `None` before.
    ks: Option<Vec<u32>>,
}

impl LastRequests {
    /// Registers a request; it may be repeated until it is given rows. Returns the k of the rows that an earlier attempt was given and that
    /// did not arrive. `None` if the request was already answered, or its client has sent a later attempt or request since.
    pub(crate) fn begin(&mut self, id: RequestId) -> Option<Vec<u32>> {
        let mut last = self.last.iter();
        let known = last.position(|it| it.id.client_id == id.client_id);
        if known.is_some_and(|at| self.last[at].id == id && self.last[at].ks.is_none()) {
            return Some(Vec::new());
        }
        let order = |id: RequestId| (id.number, id.attempt);
        let (request, lost) = match known.and_then(|at| self.last.remove(at)) {
            Some(known) if order(id) <= order(known.id) => (known, None),
            known => {
                let repeated = known.filter(|it| it.id.number == id.number);
                let lost = repeated.and_then(|it| it.ks).unwrap_or_default();
                (Request { id, ks: None }, Some(lost))
            }
        };
        if self.last.len() == CLIENTS_MAX {
            self.last.pop_front();
        }
        self.last.push_back(request);
        lost
    }

    /// Records that the last request of this client was given rows with these `ks`.
    pub(crate) fn complete(&mut self, client_id: u64, ks: Vec<u32>) {
        if let Some(request) = self.last.iter_mut().find(|it| it.id.client_id == client_id) {
            request.ks = Some(ks);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_too_many_clients_the_one_heard_of_longest_ago_is_forgotten() {
        let mut requests = LastRequests::default();
        for client_id in 0..CLIENTS_MAX as u64 {
            requests.begin(RequestId::first(client_id));
            requests.complete(client_id, vec![1]);
        }
        let again = RequestId::first(0).retry();
        assert_eq!(requests.begin(again), Some(vec![1]));
        requests.complete(0, vec![2]);
        requests.begin(RequestId::first(u64::MAX));
        assert_eq!(requests.last.len(), CLIENTS_MAX);
        assert_eq!(requests.begin(again.retry()), Some(vec![2]));
        let forgotten = RequestId::first(1).retry();
        assert_eq!(requests.begin(forgotten), Some(vec![]));
    }
}
