//! What every process of a run needs beside messages: when to end, how to write and lock a file, how seldom to log.
//! It sends nothing.

pub(crate) mod activity;
pub mod end_signs;
pub mod fault;
pub mod last_warning;
pub mod lock_file;
pub(crate) mod seldom;
pub(crate) mod shutdown;
pub mod whole_file;
