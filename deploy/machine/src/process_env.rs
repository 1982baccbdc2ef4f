//! The environment variables that a process of this program needs before its first allocation and its first tensor.
//! The C library and candle read them only once, so a process that lacks them starts itself again with them.

use std::{env, ffi::OsString, io, os::unix::process::CommandExt, path::PathBuf, process::Command};

/// The variables of every process. candle's second thread pool spins while it waits, which costs more than it gains on busy cores.
/// glibc returns each large tensor's memory to the system and faults it in again, unless these thresholds forbid it.
const COMMON_VARIABLES: [(&str, &str); 3] = [
    ("CANDLE_NUM_THREADS", "1"),
    ("MALLOC_MMAP_THRESHOLD_", "1000000000"),
    ("MALLOC_TRIM_THRESHOLD_", "10000000000"),
];
/// The additional variable of a replay server. glibc gives each thread its own heap, up to eight per core. Each heap keeps the
/// chunks freed in it, so memory only grows in a run whose actors come and go.
const REPLAY_SERVER_VARIABLE: (&str, &str) = ("MALLOC_ARENA_MAX", "2");

/// Restarts this program in the same process with the same arguments if the environment lacks one of the variables. Variables
/// that the user has set stay unchanged.
///
/// # Errors
/// The program cannot be started again. It may continue without the variables, only slower.
pub fn ensure_environment(is_replay_server: bool) -> io::Result<()> {
    let server_variable = is_replay_server.then_some(REPLAY_SERVER_VARIABLE);
    let needed = COMMON_VARIABLES.into_iter().chain(server_variable);
    let missing: Vec<_> = needed.filter(|it| env::var_os(it.0).is_none()).collect();
    match missing.is_empty() {
        true => Ok(()),
        false => restart_with(missing),
    }
}

/// Restarts this program in the same process, with the same arguments and with these variables added. Returns only if that
/// fails.
pub fn restart_with<'a>(variables: impl IntoIterator<Item = (&'a str, &'a str)>) -> io::Result<()> {
    let mut args = env::args_os();
    let name = args.next().unwrap_or_else(|| OsString::from("driml"));
    let mut command = Command::new(program_path());
    Err(command.arg0(name).args(args).envs(variables).exec())
}

/// The path of this program, to start another process of it. If a build has replaced the file, `/proc/self/exe` still reaches it.
pub fn program_path() -> PathBuf {
    let file = env::current_exe().ok().filter(|it| it.exists());
    file.unwrap_or_else(|| "/proc/self/exe".into())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    /// Set in the child process of this test, whose file is removed.
    const CHILD: &str = "DRIML_TEST_REPLACED";

    #[test]
    fn a_program_whose_file_was_replaced_starts_again() {
        let name = "process_env::tests::a_program_whose_file_was_replaced_starts_again";
        let status = |program: PathBuf| {
            let mut command = Command::new(program);
            let command = command.args(["--exact", name]).env(CHILD, "");
            command.process_group(0).status().unwrap()
        };
        match env::var_os(CHILD) {
            None => {
                let folder = tempfile::tempdir().unwrap();
                let copy = folder.path().join("program");
                fs::copy(env::current_exe().unwrap(), &copy).unwrap();
                assert!(status(copy).success());
            }
            // The first child removed this file, and then started this second child.
            Some(_) if fs::remove_file(env::current_exe().unwrap()).is_err() => {}
            Some(_) => assert!(status(program_path()).success()),
        }
    }
}
