//! A hidden fault for tests: with `DRIML_TEST_PANIC=NAME` in the environment, whoever comes to the point NAME panics.
//! It exists in debug builds only; a release build reads no such variable.

/// The variable that names the point at which to panic.
pub const VARIABLE: &str = "DRIML_TEST_PANIC";

/// Panics if `DRIML_TEST_PANIC` names this point, in a debug build; else does nothing.
///
/// Every thread that does a part's work passes one such point each time round its loop, named as the thread is. So a test can
/// show for each of them that a panic ends the process and is not swallowed with the thread.
#[inline]
#[track_caller]
pub fn point(name: &str) {
    #[cfg(debug_assertions)]
    {
        use std::sync::OnceLock;

        static WANTED: OnceLock<Option<String>> = OnceLock::new();
        let wanted = WANTED.get_or_init(|| std::env::var(VARIABLE).ok());
        assert!(wanted.as_deref() != Some(name), "{VARIABLE}={name}");
    }
    #[cfg(not(debug_assertions))]
    let _ = name;
}
