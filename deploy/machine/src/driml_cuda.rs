//! The CUDA flavour of this program, `driml-cuda`: where it is, which shared libraries it lacks, handing a call over to it.
//! It knows no device and no tensor, and is itself no part of the CUDA flavour.
//!
//! The usual program starts anywhere, as nothing in it links with CUDA. The other one does not get as far as `main` where
//! the driver is missing, and the loader's message does not say what to do: so it is looked at before it is started.

use std::{
    env,
    ffi::{OsStr, OsString},
    fmt::Write as _,
    fs::File,
    io::{Read, Seek},
    os::unix::process::CommandExt,
    path::{self, Path, PathBuf},
    process::{Command, Output, Stdio},
    time::{Duration, Instant},
};

use anyhow::{Context, bail};

use crate::error::{Usage, usage};

/// The other program's name, beside this one's file.
const NAME: &str = "driml-cuda";
/// Says where the other program is, if it is not beside this one.
const PROGRAM: &str = "DRIML_CUDA_PROGRAM";
/// Set for a program that a call was handed over to, so that it does not hand it over again.
const HANDED_OVER: &str = "DRIML_HANDED_OVER";
/// How to get the other program.
pub(crate) const TO_BUILD: &str =
    "`deploy/cuda/build.sh` builds it, also where there is neither a GPU nor a CUDA toolkit";
/// How long the other program may take to say what it lacks or which devices it finds.
const ANSWER_MAX: Duration = Duration::from_secs(60);
/// How often a program that should answer is looked at.
const POLL: Duration = Duration::from_millis(10);

/// Goes on as the CUDA flavour of this program, with the same arguments. Comes back only if that cannot be.
///
/// The error is a [`Usage`] if there is no such program, or if it lacks libraries: then it names each, with its origin.
pub(crate) fn hand_over() -> anyhow::Error {
    if env::var_os(HANDED_OVER).is_some() {
        let this = env::current_exe().unwrap_or_else(|_| NAME.into());
        return usage!(
            "{} was built without CUDA, whatever its name: {TO_BUILD}",
            this.display()
        )
        .into();
    }
    match program().and_then(|program| ready(&program, env::args_os().skip(1))) {
        Ok(mut command) => {
            let error = command.exec();
            let program = command.get_program().display().to_string();
            anyhow::Error::new(error).context(format!("starting {program}"))
        }
        Err(error) => error,
    }
}

/// Where the CUDA flavour is, or should be.
///
/// # Errors
/// The system does not say where this program's own file is.
pub(crate) fn program() -> anyhow::Result<PathBuf> {
    match env::var_os(PROGRAM).filter(|it| !it.is_empty()) {
        // Absolute: a bare name would be looked for on the PATH.
        Some(program) => path::absolute(PathBuf::from(program)).context(PROGRAM),
        None => {
            let this = env::current_exe().context("finding this program's own file")?;
            Ok(this.with_file_name(NAME))
        }
    }
}

/// The call of `program`, once it is sure that it can start.
fn ready(program: &Path, args: impl IntoIterator<Item = OsString>) -> anyhow::Result<Command> {
    if !program.is_file() {
        return Err(usage!(
            "this program was built without CUDA, and its CUDA flavour is not at {}: {TO_BUILD}; or say with {PROGRAM} where it is, or use --device cpu",
            program.display()
        )
        .into());
    }
    let missing = missing_libraries(program)?;
    if !missing.is_empty() {
        return Err(lacking(program, &missing).into());
    }
    let mut command = command(program);
    command.args(args).env(HANDED_OVER, "1");
    Ok(command)
}

/// `program`, with the folders that may hold CUDA's libraries before all others that the loader searches.
pub(crate) fn command(program: &Path) -> Command {
    let mut command = Command::new(program);
    let known = env::var_os("LD_LIBRARY_PATH").unwrap_or_default();
    if let Some(path) = library_path(&library_folders(), &known) {
        command.env("LD_LIBRARY_PATH", path);
    }
    command
}

/// Names of the shared libraries that `program` needs and the loader does not find; empty if it can start.
///
/// The loader is asked as `ldd` does it: told to trace, it lists what it would load and does not run the program.
///
/// # Errors
/// The program cannot be started, or the loader refuses it.
pub(crate) fn missing_libraries(program: &Path) -> anyhow::Result<Vec<String>> {
    let mut command = command(program);
    // The argument is for a program that is linked statically: that one runs, and should do nothing.
    command.env("LD_TRACE_LOADED_OBJECTS", "1").arg("--version");
    let doing = || format!("asking the loader what {} needs", program.display());
    let output = answer(command).with_context(doing)?;
    // Libraries are on stdout, versions of them on stderr.
    let said = [output.stdout, output.stderr].map(|it| String::from_utf8_lossy(&it).into_owned());
    let missing = not_found(&said.join("\n"));
    if !output.status.success() && missing.is_empty() {
        bail!("{}: {}: {}", doing(), output.status, said[1].trim());
    }
    Ok(missing)
}

/// Runs a program to its end and gives what it wrote.
///
/// # Errors
/// It cannot be started, or has not ended after [`ANSWER_MAX`]; then it is killed.
pub(crate) fn answer(mut command: Command) -> anyhow::Result<Output> {
    // Files and not pipes, which would have to be read while it runs.
    let (stdout, stderr) = (tempfile::tempfile()?, tempfile::tempfile()?);
    let mut child = command
        .stdin(Stdio::null())
        .stdout(stdout.try_clone()?)
        .stderr(stderr.try_clone()?)
        .spawn()?;
    let started = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if started.elapsed() > ANSWER_MAX {
            child.kill()?;
            child.wait()?;
            bail!("no answer after {} s", ANSWER_MAX.as_secs());
        }
        std::thread::sleep(POLL);
    };
    Ok(Output {
        status,
        stdout: whole(stdout)?,
        stderr: whole(stderr)?,
    })
}

fn whole(mut file: File) -> std::io::Result<Vec<u8>> {
    file.rewind()?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// What the loader's trace says is missing: libraries, and versions of the C or C++ library that are too new for this system.
fn not_found(trace: &str) -> Vec<String> {
    let mut names = Vec::new();
    for line in trace.lines() {
        let library = line.trim().strip_suffix("=> not found").map(str::trim);
        // PROGRAM: /lib/libc.so.6: version `GLIBC_2.38' not found (required by PROGRAM)
        let version = line
            .split_once("version `")
            .and_then(|(_, rest)| rest.split_once("' not found"))
            .map(|(version, _)| version);
        if let Some(name) = library.or(version) {
            names.push(name.to_owned());
        }
    }
    names.sort();
    names.dedup();
    names
}

/// The error about a program that lacks libraries.
fn lacking(program: &Path, missing: &[String]) -> Usage {
    let mut text = format!("{} cannot start here, it lacks:", program.display());
    for name in missing {
        let _ = write!(text, "\n  {name}: {}", origin(name));
    }
    Usage(text)
}

/// Where a library comes from, and what to do to have it.
pub(crate) fn origin(library: &str) -> &'static str {
    let starts = |names: &[&str]| names.iter().any(|name| library.starts_with(name));
    if starts(&["libcuda.so", "libnvidia-"]) {
        "comes with NVIDIA's driver: install it, or give the container its GPU (docker run --gpus all)"
    } else if starts(&["libcu", "libnvrtc", "libnv"]) {
        "comes with `deploy/cuda/build.sh`, which fetches it into the cache folder (DRIML_CACHE), or with the CUDA toolkit"
    } else if starts(&["GLIBC", "CXXABI"]) {
        "this system's C or C++ library is older than that of the machine it was built on: build it here with `deploy/cuda/build.sh`"
    } else {
        "comes with the system: install the package that has it"
    }
}

/// Folders with CUDA's libraries: what `deploy/cuda/build.sh` fetched first, then installed toolkits.
fn library_folders() -> Vec<PathBuf> {
    let cache = procgen_sys::Cache::from_env().ok();
    let fetched = cache.map(|cache| cache.folder.join("cuda-13.0/nvidia/cu13/lib"));
    let toolkits = ["CUDA_HOME", "CUDA_PATH"].map(|name| env::var_os(name).map(PathBuf::from));
    let toolkits = toolkits
        .into_iter()
        .flatten()
        .chain([PathBuf::from("/usr/local/cuda")])
        .map(|toolkit| toolkit.join("lib64"));
    let folders = fetched.into_iter().chain(toolkits);
    folders.filter(|folder| folder.is_dir()).collect()
}

/// The loader's search path with `folders` first; none if there is nothing to add, or a name that it cannot have.
fn library_path(folders: &[PathBuf], known: &OsStr) -> Option<OsString> {
    if folders.is_empty() {
        return None;
    }
    // An empty entry would mean the current folder.
    let known = env::split_paths(known).filter(|it| !it.as_os_str().is_empty());
    env::join_paths(folders.iter().cloned().chain(known)).ok()
}

#[cfg(test)]
mod tests {
    use std::{fs, os::unix::fs::PermissionsExt};

    use super::*;

    /// What the loader says of a program on a machine without driver and toolkit, and with an older C library.
    const TRACE: &str = "\
./driml-cuda: /lib/x86_64-linux-gnu/libc.so.6: version `GLIBC_2.39' not found (required by ./driml-cuda)
./driml-cuda: /lib/x86_64-linux-gnu/libc.so.6: version `GLIBC_2.39' not found (required by libcublas.so.13)
\tlinux-vdso.so.1 (0x00007ffd0b5f2000)
\tlibcuda.so.1 => not found
\tlibcublas.so.13 => not found
\tlibstdc++.so.6 => /lib/x86_64-linux-gnu/libstdc++.so.6 (0x00007f2d3a000000)
\t/lib64/ld-linux-x86-64.so.2 (0x00007f2d3a4c8000)
";

    #[test]
    fn the_loader_s_trace_names_what_is_missing_once() {
        let missing = not_found(TRACE);
        assert_eq!(missing, ["GLIBC_2.39", "libcublas.so.13", "libcuda.so.1"]);
        assert!(not_found("\tlibc.so.6 => /lib/libc.so.6 (0x1)\n\tstatically linked\n").is_empty());
    }

    #[test]
    fn every_missing_library_is_named_with_its_origin() {
        let missing =
            ["libcuda.so.1", "libcublas.so.13", "GLIBC_2.39", "libm.so.6"].map(Into::into);
        let text = lacking(Path::new("/bin/driml-cuda"), &missing).to_string();
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines.len(), 5, "{text}");
        assert!(lines[0].starts_with("/bin/driml-cuda cannot start here"));
        assert!(lines[1].contains("libcuda.so.1: comes with NVIDIA's driver"));
        assert!(lines[2].contains("libcublas.so.13: comes with `deploy/cuda/build.sh`"));
        assert!(lines[3].contains("build it here"));
        assert!(lines[4].contains("libm.so.6: comes with the system"));
    }

    #[test]
    fn the_loader_searches_our_folders_first() {
        let folders = [PathBuf::from("/a"), PathBuf::from("/b")];
        let path = |folders: &[PathBuf], known: &str| library_path(folders, OsStr::new(known));
        assert_eq!(path(&folders, "/c::/d"), Some("/a:/b:/c:/d".into()));
        assert_eq!(path(&folders, ""), Some("/a:/b".into()));
        assert_eq!(path(&[], "/c"), None);
    }

    #[test]
    fn without_the_other_program_the_error_says_how_to_build_it() {
        let error = ready(Path::new("/nowhere/driml-cuda"), []).unwrap_err();
        assert!(error.is::<Usage>());
        let text = error.to_string();
        for words in ["/nowhere/driml-cuda", "deploy/cuda/build.sh", PROGRAM] {
            assert!(text.contains(words), "{text}");
        }
    }

    #[test]
    fn the_other_program_gets_the_arguments_and_knows_who_called() {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join(NAME);
        fs::write(
            &program,
            "#!/bin/sh\necho \"$DRIML_HANDED_OVER: $*\"\nexit 3\n",
        )
        .unwrap();
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
        assert!(missing_libraries(&program).unwrap().is_empty());
        let args = ["local", "--device", "cuda"].map(Into::into);
        let output = answer(ready(&program, args).unwrap()).unwrap();
        assert_eq!(output.status.code(), Some(3));
        assert_eq!(output.stdout, b"1: local --device cuda\n");
    }

    #[test]
    fn a_file_that_is_no_program_is_an_error_that_names_it() {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join(NAME);
        fs::write(&program, "not executable").unwrap();
        let error = format!("{:#}", ready(&program, []).unwrap_err());
        assert!(
            error.contains("asking the loader") && error.contains(NAME),
            "{error}"
        );
    }
}
