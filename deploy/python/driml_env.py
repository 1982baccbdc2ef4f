#!/usr/bin/env python3
"""Makes a Gymnasium environment a world of driml: `driml local --env "exec:python3 driml_env.py ALE/Pong-v5 --atari"`.

It needs nothing but what it wraps. `serve` alone, which needs nothing but Python, makes a world of any object with the fields and
methods of `Gymnasium` below; what is said to driml is described in actor/envs/src/worlds/exec/mod.rs.
"""

import argparse, array, importlib, inspect, json, mmap, os, sys

RUNNING, NEXT_LEVEL, TIMED_OUT, TERMINAL = 0, 1, 2, 3


def serve(make):
    """Steps the world `make(copies)` for driml until driml has enough.

    A world has `height`, `width`, `channels` and `actions` (names), `reset(seeds)`, which gives frames, and `step(actions)`, which
    gives rewards, ends and frames; frames are anything of N * height * width * channels bytes, channels last. A copy that ended
    begins anew in the same step: its frame is the first of the next episode.
    """
    # The two pipes are driml's alone: whatever prints does so to the log, and whatever reads has nothing to read.
    asks, answers = os.fdopen(os.dup(0), "rb", 0), os.fdopen(os.dup(1), "wb", 0)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    request = json.loads(asks.readline())
    if request["driml_env"] != 1:
        sys.exit(f"this driml speaks version {request['driml_env']} of the protocol, and this file version 1: take the file that came with it")
    copies = request["copies"]
    world = make(copies)
    declaration = {"driml_env": 1, "copies": copies, "actions": list(world.actions)}
    declaration |= {"height": world.height, "width": world.width, "channels": world.channels}
    answers.write(json.dumps(declaration).encode() + b"\n")
    opening = asks.readline()
    if not opening:
        return  # It only asked what this is.
    opening = json.loads(opening)
    with open(opening["block"], "r+b") as file:
        block = mmap.mmap(file.fileno(), opening["bytes"])
    begins = lambda name, size: slice(opening[name], opening[name] + size)
    actions, rewards, ends = begins("actions", copies), begins("rewards", 4 * copies), begins("ends", copies)
    frames = begins("frames", copies * world.height * world.width * world.channels)
    block[frames] = world.reset(request["seeds"])
    answers.write(b".")
    while asks.read(1):
        earned, ended, block[frames] = world.step(block[actions])
        block[rewards] = array.array("f", earned).tobytes()
        block[ends] = bytes(ended)
        answers.write(b".")


class Gymnasium:
    """Copies of a Gymnasium environment: of one that `make()` gives, or a vector of them that `make(copies)` gives."""

    def __init__(self, make, copies, workers=False):
        import gymnasium, numpy
        from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

        self.numpy = numpy
        if inspect.signature(make).parameters:
            self.env = make(copies)
        else:
            vector = AsyncVectorEnv if workers else SyncVectorEnv
            self.env = vector([make] * copies, autoreset_mode=AutoresetMode.SAME_STEP)
        mode = AutoresetMode(self.env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        if mode == AutoresetMode.NEXT_STEP:
            # Its step after an end takes no action: as a transition it would lead from one episode into the next.
            sys.exit("a vector environment has to begin anew in the step that ends: make it with autoreset_mode=AutoresetMode.SAME_STEP or DISABLED")
        self.resets = mode == AutoresetMode.DISABLED
        if self.env.num_envs != copies:
            sys.exit(f"the vector environment has {self.env.num_envs} copies where {copies} were asked for")
        space, choice = self.env.single_observation_space, self.env.single_action_space
        if space.dtype != numpy.uint8 or len(space.shape or ()) not in (2, 3):
            sys.exit(f"observations are {space}, and driml learns from frames: bytes of height x width (x channels); try --pixels")
        if not isinstance(choice, gymnasium.spaces.Discrete):
            sys.exit(f"actions are {choice}, and driml chooses one of a few: Discrete")
        shape = (*space.shape, 1)[:3]
        self.channels_first = shape[0] < 16 < shape[2]  # As ALE's own vectors have them.
        self.height, self.width, self.channels = (*shape[1:], shape[0]) if self.channels_first else shape
        self.first_action = int(choice.start)
        inner = getattr(self.env, "envs", None)
        meanings = getattr(inner[0].unwrapped, "get_action_meanings", None) if inner else None
        names = meanings() if meanings else []
        self.actions = names if len(names) == choice.n else [str(action) for action in range(choice.n)]

    def reset(self, seeds):
        try:
            return self._frames(self.env.reset(seed=seeds)[0])
        except TypeError:  # Some take an array.
            return self._frames(self.env.reset(seed=self.numpy.array(seeds))[0])

    def step(self, actions):
        numpy = self.numpy
        chosen = numpy.frombuffer(actions, numpy.uint8).astype(numpy.int64) + self.first_action
        frames, rewards, terminated, truncated, _ = self.env.step(chosen)
        ended = terminated | truncated
        if self.resets and ended.any():
            frames, _ = self.env.reset(options={"reset_mask": ended})
        ends = numpy.where(terminated, TERMINAL, numpy.where(truncated, TIMED_OUT, RUNNING))
        return rewards, ends.astype(numpy.uint8), self._frames(frames)

    def _frames(self, frames):
        return self.numpy.ascontiguousarray(self.numpy.moveaxis(frames, 1, -1) if self.channels_first else frames)


def maker(args):
    """What makes the environment that the command line asks for."""
    if ":" in args.env:  # A function of one's own; `MODULE:ID` of Gymnasium is `--import MODULE ID` here.
        module, function = args.env.split(":", 1)
        sys.path.insert(0, os.getcwd())
        return getattr(importlib.import_module(module), function)
    import gymnasium
    from gymnasium import wrappers

    if args.env.startswith("ALE/"):
        import ale_py

        gymnasium.register_envs(ale_py)
    for module in args.imports:
        importlib.import_module(module)
    options = json.loads(args.kwargs)
    if args.atari:  # Every frame of the emulator is asked for, and four of them made one step here.
        options = {"frameskip": 1, "repeat_action_probability": 0.25} | options
    if args.pixels:
        options = {"render_mode": "rgb_array"} | options

    def make():
        env = gymnasium.make(args.env, **options)
        if args.atari:
            # Dopamine's: 4 frames a step, the larger of the last two, 84 x 84 grey, a life is not an episode, sticky actions and so no no-ops.
            env = wrappers.AtariPreprocessing(env, noop_max=0, frame_skip=4, screen_size=84, terminal_on_life_loss=False, grayscale_obs=True)
        if args.pixels:
            env = wrappers.AddRenderObservation(env, render_only=True)
        if args.size:
            env = wrappers.ResizeObservation(env, (args.size, args.size))
        if args.grey:
            env = wrappers.GrayscaleObservation(env)
        if args.clip:
            env = wrappers.TransformReward(env, lambda reward: max(-1.0, min(1.0, reward)))
        return env

    return make


def parser():
    parser = argparse.ArgumentParser(description="A Gymnasium environment as a world of driml.")
    parser.add_argument("env", help="an id such as ALE/Pong-v5, or MODULE:FUNCTION: a function without arguments that gives an environment, or with one, the number of copies, that gives a vector environment")
    parser.add_argument("--atari", action="store_true", help="Dopamine's preprocessing")
    parser.add_argument("--clip", action="store_true", help="rewards are cut to -1..1, as Dopamine's agents do; returns are of those then")
    parser.add_argument("--pixels", action="store_true", help="frames are what the environment renders")
    parser.add_argument("--size", type=int, metavar="N", help="frames are made N x N")
    parser.add_argument("--grey", action="store_true", help="frames are made grey")
    parser.add_argument("--kwargs", default="{}", metavar="JSON", help="arguments of gymnasium.make")
    parser.add_argument("--import", dest="imports", action="append", default=[], metavar="MODULE", help="what registers the environment")
    parser.add_argument("--workers", action="store_true", help="a process for each copy")
    return parser


def main():
    args = parser().parse_args()
    serve(lambda copies: Gymnasium(maker(args), copies, args.workers))


if __name__ == "__main__":
    main()
