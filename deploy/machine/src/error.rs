//! The error types that decide the program's exit code: a call that cannot work, and a run that was interrupted.
//! This module prints nothing; the program does.

/// An error for a call or a configuration that cannot work; its message says what to do. Exit code 64.
#[derive(Clone, Debug, thiserror::Error)]
#[error("{0}")]
pub struct Usage(pub String);

/// Makes a [`Usage`] from a format string.
#[doc(hidden)]
#[macro_export]
macro_rules! __usage {
    ($($arg:tt)*) => {
        $crate::error::Usage(format!($($arg)*))
    };
}
#[doc(inline)]
pub use __usage as usage;

/// Exit code of a call or configuration that cannot work (`EX_USAGE`).
pub const EXIT_USAGE: u8 = 64;
/// Exit code after Ctrl-C, the one that shells use.
pub const EXIT_INTERRUPTED: u8 = 130;

/// The error of a run that was asked to stop and has saved its state. Exit code 130, a shell's code for Ctrl-C.
#[derive(Debug, thiserror::Error)]
#[error("interrupted")]
pub struct Interrupted;

/// Returns ` (did you mean "..."?)` with the candidate most similar to `name`, or an empty string if none is similar.
pub fn did_you_mean<'a>(name: &str, candidates: impl IntoIterator<Item = &'a str>) -> String {
    let distance = |candidate: &str| strsim::levenshtein(name, candidate);
    match candidates.into_iter().min_by_key(|it| distance(it)) {
        Some(best) if distance(best) <= 1 + name.len() / 4 => format!(" (did you mean {best:?}?)"),
        _ => String::new(),
    }
}
