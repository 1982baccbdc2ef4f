//! What there is of CUDA: the driver, the CUDA flavour of this program, and in that flavour the devices.
//! Nothing here is needed for training on the CPU, and nothing is computed on a device.

use std::{fs, path::Path};

use super::fact::{Fact, State};

/// Where NVIDIA's driver describes itself and its boards.
const DRIVER_FOLDER: &str = "/proc/driver/nvidia";
/// The driver's device file, and the one of the Windows subsystem for Linux, for where that folder is hidden.
const DEVICE_FILES: [&str; 2] = ["/dev/nvidiactl", "/dev/dxg"];
/// The oldest driver for the CUDA of `deploy/cuda/build.sh`, its major version.
const DRIVER_MIN: u32 = 580;

/// How the names of facts about a device start.
const DEVICE: &str = "cuda:";

/// All of them.
pub(super) fn facts() -> Vec<Fact> {
    let driver = driver(Path::new(DRIVER_FOLDER));
    let there = driver.state != State::Missing;
    let mut facts = vec![driver];
    facts.extend(program(there));
    if !there {
        // Without a driver there is nothing to be done for the others.
        for fact in &mut facts {
            fact.state = State::Note;
        }
    }
    facts
}

/// Whether `--device cuda` has something to compute on: a device that the CUDA flavour found and was built for.
pub(super) fn is_ready(facts: &[Fact]) -> bool {
    let ready = |fact: &Fact| fact.state == State::Ok && fact.what.starts_with(DEVICE);
    facts.iter().any(ready)
}

/// The driver and the boards it drives.
fn driver(folder: &Path) -> Fact {
    let what = "CUDA driver";
    let text = fs::read_to_string(folder.join("version")).unwrap_or_default();
    match driver_version(&text) {
        Some(version) => {
            let boards = boards(folder);
            let text = format!(
                "{version}, {}",
                if boards.is_empty() {
                    "and no GPU".into()
                } else {
                    boards.join(", ")
                }
            );
            let major = version.split('.').next().and_then(|it| it.parse().ok());
            if boards.is_empty() {
                Fact::missing(what, text)
            } else if major.is_some_and(|major: u32| major < DRIVER_MIN) {
                Fact::note(
                    what,
                    format!(
                        "{text}: too old for CUDA 13, which needs {DRIVER_MIN}; update it, or build with an older toolkit (`deploy/cuda/build.sh --system-toolkit`)"
                    ),
                )
            } else {
                Fact::ok(what, text)
            }
        }
        None if DEVICE_FILES.iter().any(|file| Path::new(file).exists()) => {
            Fact::ok(what, "there, but it does not say its version here")
        }
        None => Fact::missing(
            what,
            format!(
                "there is no NVIDIA driver ({DRIVER_FOLDER} is not there), so no GPU can be used: --device cpu"
            ),
        ),
    }
}

/// `580.65.06` from the driver's own words: the first number with a point after `NVRM version:`.
fn driver_version(text: &str) -> Option<&str> {
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix("NVRM version:"))?;
    line.split_whitespace()
        .find(|word| word.contains('.') && word.chars().all(|c| c.is_ascii_digit() || c == '.'))
}

/// Names of the boards, in the order of their folders.
fn boards(folder: &Path) -> Vec<String> {
    let Ok(entries) = fs::read_dir(folder.join("gpus")) else {
        return Vec::new();
    };
    let mut files: Vec<_> = entries
        .flatten()
        .map(|entry| entry.path().join("information"))
        .collect();
    files.sort();
    let texts = files
        .iter()
        .filter_map(|file| fs::read_to_string(file).ok());
    texts
        .map(|text| board(&text).unwrap_or("a GPU without a name").to_owned())
        .collect()
}

/// The name in a board's `information`.
fn board(information: &str) -> Option<&str> {
    let mut names = information
        .lines()
        .filter_map(|line| line.strip_prefix("Model:"));
    names.next().map(str::trim).filter(|name| !name.is_empty())
}

/// The other program, what it lacks, and the devices that it finds.
#[cfg(not(feature = "cuda"))]
fn program(driver: bool) -> Vec<Fact> {
    use crate::driml_cuda as cuda;

    let what = "driml-cuda";
    let program = match cuda::program() {
        Ok(program) => program,
        Err(why) => return vec![Fact::missing(what, format!("{why:#}"))],
    };
    let shown = program.display();
    if !program.is_file() {
        let text = format!("not at {shown}: {}", cuda::TO_BUILD);
        return vec![Fact::missing(what, text)];
    }
    let missing = match cuda::missing_libraries(&program) {
        Ok(missing) => missing,
        Err(why) => return vec![Fact::missing(what, format!("{why:#}"))],
    };
    let state = if missing.is_empty() {
        "it finds all its libraries".to_owned()
    } else {
        format!("it lacks {}", missing.join(", "))
    };
    let mut facts = vec![Fact::new(
        if missing.is_empty() {
            State::Ok
        } else {
            State::Missing
        },
        what,
        format!("at {shown}; {state}"),
    )];
    let lacks = |name: &String| Fact::missing(name, cuda::origin(name));
    facts.extend(missing.iter().map(lacks));
    if missing.is_empty() && driver {
        let mut command = cuda::command(&program);
        command.args(["doctor", "--devices"]);
        match cuda::answer(command).and_then(|output| facts_in(&output)) {
            Ok(devices) => facts.extend(devices),
            Err(why) => facts.push(Fact::missing(
                "CUDA devices",
                format!("{shown} does not say what it finds: {why:#}"),
            )),
        }
    }
    facts
}

/// The facts that the other program wrote.
#[cfg(not(feature = "cuda"))]
fn facts_in(output: &std::process::Output) -> anyhow::Result<Vec<Fact>> {
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        let last = said.lines().last().unwrap_or("it said nothing").to_owned();
        anyhow::bail!("{}: {last}", output.status);
    }
    Ok(serde_json::from_slice(&output.stdout)?)
}

/// The devices: this very program is the CUDA flavour.
#[cfg(feature = "cuda")]
fn program(_driver: bool) -> Vec<Fact> {
    let built = format!(
        "this is it, for compute capability {}",
        option_env!("CUDA_COMPUTE_CAP").unwrap_or("of the machine it was built on")
    );
    let mut facts = vec![Fact::ok("driml-cuda", built)];
    facts.extend(devices());
    facts
}

/// The devices that this program can compute on.
#[cfg(not(feature = "cuda"))]
pub(super) fn devices() -> Vec<Fact> {
    vec![Fact::missing(
        "CUDA devices",
        format!(
            "this program was built without CUDA: {}",
            crate::driml_cuda::TO_BUILD
        ),
    )]
}

/// The devices that this program can compute on.
#[cfg(feature = "cuda")]
pub(super) fn devices() -> Vec<Fact> {
    match count() {
        Ok(count) => (0..count).map(described).collect(),
        Err(none) => vec![none],
    }
}

/// Makes sure that there is a device with this number, and that this program was built for it.
///
/// # Errors
/// What is wrong with it, and what to do.
#[cfg(feature = "cuda")]
pub fn check(ordinal: usize) -> Result<(), crate::error::Usage> {
    let fact = match count() {
        Ok(count) if ordinal < count => described(ordinal),
        Ok(count) => Fact::missing(
            DEVICE,
            format!("the driver finds {count} device(s), counted from cuda:0"),
        ),
        Err(none) => none,
    };
    match fact.state {
        State::Ok => Ok(()),
        _ => Err(crate::error::usage!(
            "{DEVICE}{ordinal} cannot be used: {}",
            fact.text
        )),
    }
}

/// A device as it is printed: its name, compute capability and memory.
#[cfg(feature = "cuda")]
pub fn name(ordinal: usize) -> String {
    described(ordinal).text
}

/// How many devices the driver finds, at least one; else why there is none.
#[cfg(feature = "cuda")]
fn count() -> Result<usize, Fact> {
    use candle_core::cuda_backend::cudarc::driver::CudaContext;

    let why = match CudaContext::device_count() {
        Ok(0) => "the driver finds none; does CUDA_VISIBLE_DEVICES hide them?".to_owned(),
        Ok(count) => return Ok(count as usize),
        Err(why) => format!("asking the driver: {why}"),
    };
    Err(Fact::missing("CUDA devices", why))
}

/// One device, also if the driver does not describe it.
#[cfg(feature = "cuda")]
fn described(ordinal: usize) -> Fact {
    let what = format!("{DEVICE}{ordinal}");
    device(ordinal, &what)
        .unwrap_or_else(|why| Fact::missing(&what, format!("asking for its properties: {why}")))
}

/// One device: its name, compute capability and memory, and whether this program was built for it.
#[cfg(feature = "cuda")]
fn device(
    ordinal: usize,
    what: &str,
) -> Result<Fact, candle_core::cuda_backend::cudarc::driver::DriverError> {
    use candle_core::cuda_backend::cudarc::driver::CudaContext;

    let context = CudaContext::new(ordinal)?;
    let (name, (major, minor)) = (context.name()?, context.compute_capability()?);
    let (free, total) = context.mem_get_info()?;
    let [free, total] = [free, total].map(|bytes| crate::units::gib(bytes as u64));
    let text = format!("{name}, compute capability {major}.{minor}, {total}, {free} free");
    let built = option_env!("CUDA_COMPUTE_CAP").and_then(|it| it.parse().ok());
    Ok(match built {
        Some(built) if !runs_on(built, (major, minor)) => Fact::missing(
            what,
            format!(
                "{text}; this program is for {built}: build it again with `deploy/cuda/build.sh --compute-cap {major}{minor}`"
            ),
        ),
        _ => Fact::ok(what, text),
    })
}

/// Whether kernels that were compiled for the capability `built`, such as 90 for 9.0, run on one of `major.minor`.
///
/// Source: nvcc's rules. From 9.0 on candle's are compiled for the architecture's own instructions, which no other has;
/// below, the driver compiles them for whatever is newer.
#[cfg(any(test, feature = "cuda"))]
fn runs_on(built: i32, (major, minor): (i32, i32)) -> bool {
    let device = 10 * major + minor;
    if built >= 90 {
        device == built
    } else {
        device >= built
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_driver_s_version_is_read_from_its_own_words() {
        let closed = "NVRM version: NVIDIA UNIX x86_64 Kernel Module  535.183.01  Sun May 12 19:39:15 UTC 2024\nGCC version:  gcc version 12.3.0 (Ubuntu 12.3.0-1ubuntu1)\n";
        assert_eq!(driver_version(closed), Some("535.183.01"));
        let open = "NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  580.65.06  Release Build  (dvs-builder)\n";
        assert_eq!(driver_version(open), Some("580.65.06"));
        assert_eq!(driver_version(""), None);
        assert_eq!(driver_version("GCC version: 12.3.0\n"), None);
    }

    #[test]
    fn a_driver_is_judged_by_its_version_and_its_boards() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(
            driver(folder.path()).state == State::Ok,
            Path::new(DEVICE_FILES[0]).exists() || Path::new(DEVICE_FILES[1]).exists()
        );
        let version = |number: &str| {
            let text = format!("NVRM version: NVIDIA UNIX x86_64 Kernel Module  {number}  Sun\n");
            fs::write(folder.path().join("version"), text).unwrap();
            driver(folder.path())
        };
        assert_eq!(version("580.65.06").state, State::Missing, "no GPU");
        let gpu = folder.path().join("gpus/0000:01:00.0");
        fs::create_dir_all(&gpu).unwrap();
        let text = "Model: \t\t NVIDIA H100 PCIe\nIRQ:   \t\t 130\nGPU UUID: \t GPU-1\n";
        fs::write(gpu.join("information"), text).unwrap();
        assert_eq!(
            version("580.65.06"),
            Fact::ok("CUDA driver", "580.65.06, NVIDIA H100 PCIe")
        );
        assert_eq!(version("535.183.01").state, State::Note);
    }

    #[test]
    fn a_board_without_a_name_has_none() {
        assert_eq!(
            board("Model: \t\t NVIDIA H200\nIRQ: 1\n"),
            Some("NVIDIA H200")
        );
        assert_eq!(board("Model:   \n"), None);
        assert_eq!(board("IRQ: 1\n"), None);
    }

    #[test]
    fn kernels_run_where_nvcc_s_rules_say() {
        assert!(runs_on(90, (9, 0)) && !runs_on(90, (8, 9)) && !runs_on(90, (10, 0)));
        assert!(
            runs_on(80, (8, 0))
                && runs_on(80, (8, 6))
                && runs_on(80, (9, 0))
                && !runs_on(80, (7, 5))
        );
    }
}
