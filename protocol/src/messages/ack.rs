//! The answer that says no more than that a message was understood.

use serde::{Deserialize, Serialize};

/// "Understood".
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ack;
