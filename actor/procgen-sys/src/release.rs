//! Which release of Procgen the engine comes from: its version, its wheel, their hashes, the command that fetches it.
//! It fetches nothing itself.

use std::path::Path;

/// The version of the engine.
pub const VERSION: &str = "0.10.7";

/// The wheel's file name. It is the one for CPython 3.10, but no Python is needed to use the engine in it.
pub const WHEEL_NAME: &str =
    "procgen-0.10.7-cp310-cp310-manylinux_2_17_x86_64.manylinux2014_x86_64.whl";

/// SHA-256 of the wheel, computed from the file that the Python package index serves.
pub const WHEEL_SHA256: &str = "4b594d14e42f0f2166e59a9e294477b906eb99c90c3343b570b7124cbc865f53";

/// SHA-256 of `libenv.so` in that wheel.
pub const LIBENV_SHA256: &str = "f44786431a902e9ae1a32cd44f4aa650f4bdad893240a322e49e6098d6a7a2ea";

/// SHA-256 of the pictures in that wheel: of what `sha256sum` prints for all files below `assets`, sorted by path.
pub(crate) const ASSETS_SHA256: &str =
    "ed5159a184ce933cc95f3506040819ba0a1e985c7450239dec2360a1cda744d4";

/// Arguments of the command that fetches the wheel into the folder `to`.
pub(crate) fn pip_arguments(to: &Path) -> Vec<String> {
    let mut arguments: Vec<String> = [
        "download",
        "procgen==0.10.7",
        "--no-deps",
        "--only-binary=:all:",
        "--python-version",
        "3.10",
        "--abi",
        "cp310",
        "--platform",
        "manylinux2014_x86_64",
        "--disable-pip-version-check",
        "--no-input",
        "--retries",
        "2",
        "--dest",
    ]
    .map(str::to_owned)
    .into();
    arguments.push(to.display().to_string());
    arguments
}

/// The command that fetches the wheel into `to`, for people to run by hand.
pub fn download_command(to: &Path) -> String {
    format!("pip {}", pip_arguments(to).join(" "))
}
