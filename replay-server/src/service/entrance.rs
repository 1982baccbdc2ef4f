//! The way in to the service: until the replay is read back from disk everybody is told how far it is, and nothing else happens.
//! What is asked afterwards is dealt with in the files named for the messages.

use std::sync::{Arc, OnceLock};

use driml_protocol::Recovering;

use super::server::Service;
use crate::persist::Reading;

/// What stands between the questions and the service.
pub(super) struct Entrance {
    service: OnceLock<Arc<Service>>,
    reading: Reading,
    config_toml: String,
}

impl Entrance {
    /// Nobody is let in yet.
    pub(super) const fn closed(reading: Reading, config_toml: String) -> Self {
        Self {
            service: OnceLock::new(),
            reading,
            config_toml,
        }
    }

    /// Lets everybody in, for good.
    pub(super) fn open(&self, service: Arc<Service>) {
        let opened = self.service.set(service);
        assert!(opened.is_ok(), "a replay is read back once");
    }

    /// The service, once it is there.
    pub(super) fn service(&self) -> Option<&Arc<Service>> {
        self.service.get()
    }

    /// How far the reading is, and whether it need go on.
    pub(super) const fn reading(&self) -> &Reading {
        &self.reading
    }

    /// What whoever asks is told meanwhile.
    pub(super) fn put_off(&self) -> Recovering {
        Recovering {
            progress: self.reading.progress(),
            config_toml: None,
        }
    }

    /// The same for whoever asks which run it is.
    pub(super) fn put_off_with_settings(&self) -> Recovering {
        Recovering {
            config_toml: Some(self.config_toml.clone()),
            ..self.put_off()
        }
    }
}
