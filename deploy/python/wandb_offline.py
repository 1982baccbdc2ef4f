"""Logs a run's metrics.csv to Weights & Biases, offline: nothing is sent and no account is needed.

    python wandb_offline.py RUN [--project driml] [--dir WHERE]

`wandb sync WHERE/wandb/offline-run-*` sends it later. Every numeric column is logged over frames; config.toml becomes the run's config.
"""

import argparse
import csv
import sys
from pathlib import Path

try:
    import wandb
except ModuleNotFoundError:
    sys.exit(f"wandb_offline.py needs the package wandb: {sys.executable} -m pip install wandb")
try:
    import tomllib
except ModuleNotFoundError:
    sys.exit("wandb_offline.py needs Python 3.11 or newer")


def numbers(row):
    """The cells of a row that are numbers; empty ones were not computed."""
    found = {}
    for name, cell in row.items():
        try:
            found[name] = float(cell)
        except ValueError:
            pass
    return found


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("run", type=Path, help="folder of the run")
    arguments.add_argument("--project", default="driml")
    arguments.add_argument("--dir", type=Path, default=Path("."), help="where wandb/ goes")
    given = arguments.parse_args()
    config = tomllib.loads((given.run / "config.toml").read_text())
    run = wandb.init(project=given.project, name=given.run.name, config=config, dir=given.dir, mode="offline")
    run.define_metric("*", step_metric="frames")
    rows = 0
    with open(given.run / "metrics.csv", newline="") as file:
        for row in csv.DictReader(file):
            # A last row that is still being written lacks cells.
            if None not in row.values():
                run.log(numbers(row))
                rows += 1
    run.finish()
    print(f"logged {rows} rows of {given.run}")


if __name__ == "__main__":
    main()
