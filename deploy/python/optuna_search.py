"""Searches settings with Optuna: each trial is `driml train` with other settings, judged by `driml evaluate --json`.

    python optuna_search.py [--trials 20] [--env chain] [--agent driml-ada] [--frames 12000] [--seeds 2] [--out search]

Change `suggest` to what you search. Runs stay in OUT, and so does the study: called again, it goes on. A search over few seeds finds settings
that suit these seeds: judge the best anew with others, `driml sweep --seeds`.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

try:
    import optuna
except ModuleNotFoundError:
    sys.exit(f"optuna_search.py needs the package optuna: {sys.executable} -m pip install optuna")


def suggest(trial):
    """The settings of a trial, as `driml train --set` takes them; `driml presets --env G --agent A` lists all."""
    return {
        "learner.update.adam.lr": trial.suggest_float("lr", 1e-5, 1e-2, log=True),
        "replay.replay_ratio": trial.suggest_categorical("replay_ratio", [4, 8, 16]),
    }


def output_of(command):
    """What a command prints; what it says on stderr ends the search if it fails."""
    ended = subprocess.run(command, capture_output=True, text=True)
    if ended.returncode != 0:
        raise SystemExit(f"{' '.join(command)}: {ended.stderr}")
    return ended.stdout


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--driml", default="driml", help="the program")
    arguments.add_argument("--trials", type=int, default=20)
    arguments.add_argument("--env", default="chain")
    arguments.add_argument("--agent", default="driml-ada")
    arguments.add_argument("--frames", default="12000")
    arguments.add_argument("--seeds", type=int, default=2)
    arguments.add_argument("--out", type=Path, default=Path("search"))
    given = arguments.parse_args()

    def objective(trial):
        """Mean return over seeds of whole episodes, greedily."""
        sets = [word for name, value in suggest(trial).items() for word in ("--set", f"{name}={value}")]
        returns = []
        for seed in range(1, given.seeds + 1):
            run = given.out / f"trial{trial.number}-seed{seed}"
            world = ["--env", given.env, "--agent", given.agent, "--frames", given.frames]
            output_of([given.driml, "local", "--no-play", *world, "--seed", str(seed), "--run-dir", str(run), *sets])
            told = json.loads(output_of([given.driml, "evaluate", str(run), "--episodes", "50", "--json"]))
            returns.append(told["policies"][given.agent]["mean_return"])
        return sum(returns) / len(returns)

    given.out.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        study_name="driml", direction="maximize", storage=f"sqlite:///{given.out}/study.db", load_if_exists=True
    )
    study.optimize(objective, n_trials=given.trials)
    print(f"best: {study.best_value:.3f} with {study.best_params}, trial {study.best_trial.number} in {given.out}")


if __name__ == "__main__":
    main()
