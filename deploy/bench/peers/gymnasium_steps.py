"""A Gymnasium environment's steps in Gymnasium's own loop: the vector that driml_env.py makes, without driml around it.

It takes the arguments of driml_env.py and is the same work as `driml bench env --env "exec:python3 driml_env.py ARGUMENTS"`.
"""

import os
import sys

import gymnasium
import numpy

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "../../python"))
import driml_env
import measure

ENVS = 32
# Steps of which a call that is timed consists.
STEPS = 64


def main():
    quick = "--quick" in sys.argv
    args = driml_env.parser().parse_args([arg for arg in sys.argv[1:] if arg != "--quick"])
    world = driml_env.Gymnasium(driml_env.maker(args), ENVS, args.workers, args.channels)
    env, first = world.env, world.first_action
    env.reset(seed=list(range(ENVS)))
    actions = numpy.random.default_rng(1).integers(first, first + len(world.actions), (STEPS, ENVS))

    def steps():
        for step in actions:
            env.step(step)

    figures = {}
    rate = ENVS * STEPS * measure.Effort(quick).rate_overall(steps)
    measure.found(figures, f"{args.env}, {ENVS} environments", rate, "steps/s")
    measure.report(f"gymnasium {gymnasium.__version__}", figures)


if __name__ == "__main__":
    main()
