//! Other programs that read a run: `deploy/python` must give the numbers that driml computes itself.
//! Each test is skipped by name if no Python has the modules that it needs.

use std::{
    fs::{self, File},
    process::Command,
};

use driml_learner::{
    Agent, Compute, checkpoint,
    insight::{Insight, NetworkOutputs},
};
use driml_machine::resources::Machine;
use driml_settings::{config::RunConfig, flags::resolve_names};
use driml_tests::{
    Process, TestSystem, check_has, print_line,
    python::{find_python, run_script},
};
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    repo_rules::{read, root},
    system,
};

/// The largest allowed difference of a value, and of a probability, between PyTorch and driml, both in f32.
const VALUE_ERROR_MAX: f64 = 2e-5;
const PROB_ERROR_MAX: f64 = 2e-6;
/// The number of states that are compared.
const STATES: usize = 16;

/// A script that prints values and probabilities of the states in a file, as JSON.
const TORCH_PY: &str = "
import json, sys
sys.path.insert(0, sys.argv[1])
import torch
from driml_net import load
network, described = load(sys.argv[2])
model = described['model']
states = torch.frombuffer(bytearray(open(sys.argv[3], 'rb').read()), dtype=torch.uint8)
states = states.reshape(-1, model['height'], model['width'], model['input_channels'])
with torch.no_grad():
    values, logits = network(states), network.logits(states)
print(json.dumps([values.flatten().tolist(), logits.softmax(-1).flatten().tolist()]))
";

/// A script that prints the values that ONNX Runtime computes.
const ONNX_PY: &str = "
import json, sys
import numpy, onnxruntime
session = onnxruntime.InferenceSession(sys.argv[1], providers=['CPUExecutionProvider'])
shape = [int(it) for it in sys.argv[3].split(',')]
states = numpy.fromfile(sys.argv[2], dtype=numpy.uint8).reshape(shape)
print(json.dumps(session.run(['q_values'], {'states': states})[0].flatten().tolist()))
";

/// A run of each kind of network: all heads of local and global DIM with enlarged stacks, C51 alone with averaged weights, Rainbow's
/// streams of noisy layers, and the residual torsos.
const RUN_FLAGS: [&str; 5] = [
    "--env mspacman --agent driml-ada --preset smoke --frames 320",
    "--env chain --agent c51 --preset smoke --frames 320 --set learner.update.average_tau=0.01",
    "--env chain --agent rainbow --preset smoke --frames 320",
    "--env mspacman --agent driml-ada --preset smoke --frames 320 --set model.torso=impala --set model.channels=[4,6]",
    "--env chain --agent c51 --preset smoke --frames 320 --set model.torso=impoola --set model.channels=[4,6]",
];

/// Makes a run. Returns its agent and the agent's outputs for random states, which are in a file beside the run.
fn train_agent(system: &TestSystem, flags: &str) -> (Agent, NetworkOutputs) {
    let _ = fs::remove_dir_all(system.path("run"));
    system.run_ok(&format!("local --lockstep {flags} --run-dir run"));
    let config = RunConfig::parse("config.toml", &system.read("run/config.toml")).unwrap();
    let folder = system.path("run/checkpoints");
    let (model, update) = (&config.model, &config.learner.update);
    let restored =
        checkpoint::load_latest(&folder, model, update, &Compute::CPU, config.run.hash());
    let mut states = vec![0; STATES * model.frame_len()];
    ChaCha8Rng::seed_from_u64(1).fill_bytes(&mut states);
    fs::write(system.path("states"), &states).unwrap();
    let mut agent = restored.unwrap().unwrap().agent;
    agent.copy_average_to_online().unwrap();
    let insight = Insight::new(model, update, agent.online(), Compute::CPU, None).unwrap();
    let ours = insight.evaluate(&states).unwrap();
    (agent, ours)
}

fn largest_difference(ours: &[f32], theirs: &serde_json::Value) -> f64 {
    let theirs = theirs.as_array().unwrap();
    assert_eq!(ours.len(), theirs.len());
    let off = ours.iter().zip(theirs);
    let off = off.map(|(&a, b)| (f64::from(a) - b.as_f64().unwrap()).abs());
    off.fold(0.0, f64::max)
}

#[test]
fn pytorch_and_onnx_runtime_compute_what_driml_does() {
    let Some(python) = find_python(&["torch"]) else {
        return;
    };
    let has_onnx = find_python(&["onnx", "onnxscript", "onnxruntime"]).is_some();
    let system = system();
    let scripts = root().join("deploy/python");
    let script = scripts.join("driml_net.py").display().to_string();
    for flags in RUN_FLAGS {
        let (agent, ours) = train_agent(&system, flags);
        let path = |name: &str| system.path(name).display().to_string();
        let args = [
            &scripts.display().to_string(),
            &path("run"),
            &path("states"),
        ];
        let args = args.map(String::as_str);
        let torch_outputs = || -> serde_json::Value {
            serde_json::from_str(&run_script(&python, &["-c", TORCH_PY], &args)).unwrap()
        };
        let theirs = torch_outputs();
        let value = largest_difference(&ours.q_values, &theirs[0]);
        let probability = largest_difference(&ours.probabilities, &theirs[1]);
        print_line(&format!(
            "{flags}: values {value:.1e}, probabilities {probability:.1e}"
        ));
        assert!(value < VALUE_ERROR_MAX, "{flags}: {value}");
        assert!(probability < PROB_ERROR_MAX, "{flags}: {probability}");
        if has_onnx {
            let net = path("net.onnx");
            let output = run_script(&python, &[&script], &[&path("run"), "--onnx", &net]);
            assert!(output.contains("wrote"), "{output}");
            let model = agent.model();
            let [height, width] = [model.height, model.width];
            let shape = format!("-1,{height},{width},{}", model.input_channels);
            let answer = run_script(&python, &["-c", ONNX_PY], &[&net, &path("states"), &shape]);
            let off = largest_difference(&ours.q_values, &serde_json::from_str(&answer).unwrap());
            print_line(&format!("{flags}: ONNX values {off:.1e}"));
            assert!(off < VALUE_ERROR_MAX, "{flags}: {off}");
        }
        // A checkpoint of an earlier version has no metadata; `config.toml` contains the same facts.
        let newest = system.run_folder("run").newest_checkpoint();
        let bare = agent.online().to_safetensors(|_| true).unwrap();
        fs::write(newest.join("online.safetensors"), bare).unwrap();
        assert_eq!(torch_outputs(), theirs);
    }
}

#[test]
fn the_page_has_the_actions_in_their_order() {
    let page = read("deploy/docs/src/reference/weights.md");
    for world in ["chain", "mspacman", "ising", "procgen:coinrun"] {
        let config = resolve_names("smoke", world, "c51", &[], &Machine::detect()).unwrap();
        let names = config.world.action_names().join(", ");
        let world = world.replace("coinrun", "GAME");
        let line = format!("| `{world}` | `{names}` |");
        assert!(page.lines().any(|it| it == line), "{line}");
    }
}

#[test]
fn optuna_searches() {
    let Some(python) = find_python(&["optuna"]) else {
        return;
    };
    let system = system();
    let script = root().join("deploy/python/optuna_search.py");
    let out = system.path("search");
    let search = || {
        let flags = "--trials 1 --seeds 2 --agent c51 --frames 2000";
        let mut args: Vec<_> = flags.split(' ').collect();
        args.extend([
            "--driml",
            env!("CARGO_BIN_EXE_driml-under-test"),
            "--out",
            out.to_str().unwrap(),
        ]);
        run_script(&python, &[script.to_str().unwrap()], &args)
    };
    check_has(&search(), &["best: ", "replay_ratio"]);
    // The search continues: the second trial has number 1.
    search();
    for trial in ["trial0-seed1", "trial0-seed2", "trial1-seed2"] {
        assert!(out.join(trial).join("summary.json").exists(), "{trial}");
    }
}

#[test]
fn a_helper_without_its_package_says_which() {
    let Some(python) = find_python(&[]) else {
        return;
    };
    let system = system();
    let declaration = system.path("declaration");
    fs::write(&declaration, "{\"driml_env\": 1, \"copies\": 1}\n").unwrap();
    for (script, args, package) in [
        ("optuna_search.py", &[][..], "optuna"),
        ("wandb_offline.py", &["run"], "wandb"),
        ("driml_net.py", &["run"], "torch"),
        ("driml_env.py", &["CartPole-v1"], "gymnasium"),
    ] {
        // Without `site` no installed package is found.
        let mut command = Command::new(&python);
        command
            .arg("-S")
            .arg(root().join("deploy/python").join(script));
        command.args(args).env_remove("PYTHONPATH");
        command.stdin(File::open(&declaration).unwrap());
        let process = Process::start(script.into(), command);
        let stderr = process.wait().expect_code(1).stderr;
        let names = format!("{script} needs the package {package}: ");
        let install = format!("-m pip install {package}\n");
        let is_told = stderr.starts_with(&names) && stderr.ends_with(&install);
        assert!(is_told, "{stderr}");
    }
}
