//! Tells the program which commit it is built from, for `driml --version` and for tables of results.
//! Outside a checkout of the repository the commit is "unknown".

use std::{path::Path, process::Command};

fn main() {
    let git = |args: &[&str]| {
        let output = Command::new("git").args(args).output().ok()?;
        let text = String::from_utf8(output.stdout).ok()?;
        output.status.success().then(|| text.trim().to_owned())
    };
    let commit = git(&["rev-parse", "--short", "HEAD"]);
    let commit = commit.unwrap_or_else(|| "unknown".into());
    println!("cargo::rustc-env=DRIML_COMMIT={commit}");
    println!("cargo::rerun-if-changed=build.rs");
    // It grows with each commit. A path that does not exist would run this script each time.
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"])
        && Path::new(&log).exists()
    {
        println!("cargo::rerun-if-changed={log}");
    }
}
