"""Procgen's steps through gym3, as a Python program takes them: act, observe, frames at hand after each step.

It is the same work as `driml bench env`: the same engine, games, environments, threads and options, actions drawn beforehand.
"""

import importlib.metadata

import numpy
from procgen import ProcgenGym3Env

import measure

GAMES = ("bigfish", "coinrun", "maze", "starpilot")
ENVS = 32
ENGINE_THREADS = (0, 2)
# Steps of which a call that is timed consists.
STEPS = 64


def main():
    args = measure.parser(__doc__).parse_args()
    effort, figures = measure.Effort(args.quick), {}
    rng = numpy.random.default_rng(1)
    actions = rng.integers(0, 15, (STEPS, ENVS), dtype=numpy.int32)
    for game in GAMES:
        for threads in ENGINE_THREADS:
            env = ProcgenGym3Env(
                num=ENVS,
                env_name=game,
                num_threads=threads,
                distribution_mode="easy",
                num_levels=500,
                start_level=0,
                use_sequential_levels=True,
                paint_vel_info=True,
                rand_seed=1,
            )

            def steps():
                for step in actions:
                    env.act(step)
                    _, observation, _ = env.observe()
                    observation["rgb"]

            rate = ENVS * STEPS * effort.rate_overall(steps)
            measure.found(figures, f"{game}, {ENVS} environments, {threads} engine threads", rate, "steps/s")
            env.close()
    versions = [f"{name} {importlib.metadata.version(name)}" for name in ("gym3", "procgen")]
    measure.report(", ".join(versions), figures)


if __name__ == "__main__":
    main()
