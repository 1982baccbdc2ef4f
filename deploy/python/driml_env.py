#!/usr/bin/env python3
"""Makes a Gymnasium environment a world of driml: `driml train --env "exec:python3 driml_env.py ALE/Pong-v5 --atari"`.

It needs nothing but what it wraps. `serve` alone, which needs nothing but Python, makes a world of any object with the fields and
methods of `Gymnasium` below; what is said to driml is described in actor/envs/src/worlds/exec/protocol.rs.
"""

import argparse, array, importlib, inspect, io, json, mmap, os, pickle, platform, random, sys, types

RUNNING, NEXT_LEVEL, TIMED_OUT, TERMINAL = 0, 1, 2, 3


class NotSaved(Exception):
    """Raised by a world's `save_state` where it cannot be done after all; says why."""


def serve(make):
    """Steps the world `make(copies)` for driml until driml has enough.

    A world has `height`, `width`, `channels` and `actions` (names), `reset(seeds)`, which gives frames, and `step(actions)`, which
    gives rewards, ends and frames; frames are anything of N * height * width * channels bytes, channels last. A copy that ended
    begins anew in the same step: its frame is the first of the next episode.

    A world that has `save_state()`, which gives bytes, and `load_state(bytes)` can be saved: what loads a state goes on exactly as
    what saved it did, so generators belong to it. The frames that `step` gave last do not: driml keeps them.
    """
    # The two pipes are driml's alone: whatever prints does so to the log, and whatever reads has nothing to read.
    asks, answers = os.fdopen(os.dup(0), "rb", 0), os.fdopen(os.dup(1), "wb", 0)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    request = json.loads(asks.readline())
    if request["driml_env"] != 1:
        sys.exit(f"this driml uses version {request['driml_env']} of the protocol, and this file version 1: use the file of that driml")
    copies = request["copies"]
    world = make(copies)
    declaration = {"driml_env": 1, "copies": copies, "actions": list(world.actions)}
    declaration |= {"height": world.height, "width": world.width, "channels": world.channels}
    if hasattr(world, "save_state") and hasattr(world, "load_state"):
        declaration["saves"] = True
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
    while asked := asks.read(1):
        if asked == b"s":
            earned, ended, block[frames] = world.step(block[actions])
            block[rewards] = array.array("f", earned).tobytes()
            block[ends] = bytes(ended)
            answers.write(b".")
        elif asked == b"S":
            answers.write(save(world, json.loads(asks.readline())))
        elif asked == b"L":
            with open(json.loads(asks.readline())["state"], "rb") as file:
                world.load_state(file.read())
            answers.write(b".")
        else:
            sys.exit(f"this driml asks for {asked}, which this file does not know: use the file of that driml")


def save(world, place):
    """Writes the state of a world where driml wants it, and gives the answer."""
    try:
        state = world.save_state()
    except NotSaved as why:
        return b"-" + " ".join(str(why).split()).encode() + b"\n"
    if len(state) > place["bytes_max"]:
        return f"-its state has {len(state)} bytes, and {place['bytes_max']} are possible\n".encode()
    with open(place["state"], "wb") as file:
        file.write(state)
    return b"."


class Gymnasium:
    """Copies of a Gymnasium environment: of one that `make()` gives, or a vector of them that `make(copies)` gives."""

    def __init__(self, make, copies, workers=False, channels=None):
        import gymnasium, numpy
        try:
            from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
        except ImportError:
            sys.exit(f"driml_env.py needs gymnasium 1.1 or newer, and this is {gymnasium.__version__}: {sys.executable} -m pip install -U gymnasium")

        self.numpy = numpy
        if takes_copies(make):
            self.env = make(copies)
        else:
            vector = AsyncVectorEnv if workers else SyncVectorEnv
            self.env = vector([make] * copies, autoreset_mode=AutoresetMode.SAME_STEP)
        self.layers = Layers(self.env)
        mode = AutoresetMode(self.env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        if mode == AutoresetMode.NEXT_STEP:
            # Its step after an end takes no action: as a transition it would lead from one episode into the next.
            sys.exit("a vector environment must reset in the step that ends an episode: make it with autoreset_mode=AutoresetMode.SAME_STEP or DISABLED")
        self.resets = mode == AutoresetMode.DISABLED
        if self.env.num_envs != copies:
            sys.exit(f"the vector environment has {self.env.num_envs} copies, and driml asked for {copies}")
        space, choice = self.env.single_observation_space, self.env.single_action_space
        if space.dtype != numpy.uint8 or len(space.shape or ()) not in (2, 3):
            sys.exit(f"observations are {space}, but driml learns from frames, bytes of height x width (x channels): try --pixels")
        if not isinstance(choice, gymnasium.spaces.Discrete):
            sys.exit(f"actions are {choice}, but driml needs a Discrete space")
        shape = (*space.shape, 1)[:3]
        if len(space.shape) == 2:
            channels = "last"
        elif not channels:  # There are fewer of them than rows and columns.
            channels = "last" if shape[2] < min(shape[:2]) else "first" if shape[0] < min(shape[1:]) else None
        if not channels:
            sys.exit(f"frames of {shape} can have their channels first or last: add --channels first or --channels last")
        self.channels_first = channels == "first"  # As ALE's own vectors have them.
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

    def save_state(self):
        return self.layers.save()

    def load_state(self, state):
        self.layers.load(state)

    def _frames(self, frames):
        return self.numpy.ascontiguousarray(self.numpy.moveaxis(frames, 1, -1) if self.channels_first else frames)


def environments(held):
    """What an attribute holds, as a list, if that is a Gymnasium environment or several."""
    gymnasium = sys.modules["gymnasium"]
    found = held if isinstance(held, (list, tuple)) else [held]
    return found if all(isinstance(it, (gymnasium.Env, gymnasium.vector.VectorEnv)) for it in found) else []


class Layers:
    """An environment, those that it wraps and those in a vector: what each of them holds, and how they take it back.

    A layer with methods `save_state` and `load_state` of its own says so itself, generators included; ALE's is its emulator's. Of any
    other it is all attributes, as `pickle` copies them, with what functions without a name hold in their closures. What cannot be copied
    cannot be saved.
    """

    KEPT = {"env_fns", "spec", "_cached_spec"}  # As they were made.
    INNER = ("env", "envs")  # Where wrappers and vectors hold environments, and others what they like.

    def __init__(self, env):
        self.layers = []
        self._add(env)

    def _add(self, env):
        self.layers.append(env)
        if is_ale(env):
            env.ale = Emulator(env.ale)
        for name in self.INNER:
            for inner in environments(vars(env).get(name)):
                self._add(inner)

    def _kept(self, layer):
        """The names of a layer's attributes that are not saved with it: environments are layers too."""
        return self.KEPT.union(name for name in self.INNER if environments(vars(layer).get(name)))

    def save(self):
        for layer in self.layers:
            if hasattr(layer, "processes"):
                raise NotSaved("the copies run in other processes: leave --workers out to save them")
        file = io.BytesIO()
        try:
            places, cells = self._places()
            content = [self._content(layer) for layer in self.layers]
            generators = random.getstate(), sys.modules["numpy"].random.get_state()
            state = made_with(), generators, content, [cell.cell_contents for cell in cells]
            Pickler(file, {id(it): place for place, it in places.items()}).dump(state)
        except NotSaved:
            raise
        except Exception as why:  # What an environment holds may say no in any way.
            raise NotSaved(f"{type(why).__name__}: {why}") from why
        return file.getvalue()

    def load(self, state):
        places, cells = self._places()
        try:
            made, (python, numpy), content, contents = Unpickler(io.BytesIO(state), places).load()
        except KeyError as why:
            sys.exit(f"the state belongs to another world: this one has no {why}")
        if made != made_with():
            sys.exit(f"the state was saved with {made}, and this is {made_with()}: resume with the same versions")
        if len(content) != len(self.layers) or len(contents) != len(cells):
            sys.exit(f"the state belongs to another world: it has {len(content)} environments and wrappers, this one {len(self.layers)}")
        for layer, saved in zip(self.layers, content):
            self._take(layer, saved)
        for cell, saved in zip(cells, contents):
            cell.cell_contents = saved
        random.setstate(python)
        sys.modules["numpy"].random.set_state(numpy)

    def _content(self, layer):
        if offers_state(layer):
            return layer.save_state()
        if not is_ale(layer):
            kept = self._kept(layer)
            return {name: value for name, value in vars(layer).items() if name not in kept}
        return layer.ale.save(), vars(layer).get("_np_random"), vars(layer).get("_np_random_seed")

    def _take(self, layer, saved):
        if offers_state(layer):
            layer.load_state(saved)
        elif is_ale(layer):
            emulator, layer._np_random, layer._np_random_seed = saved
            layer.ale.load(*emulator)
        else:
            for name in vars(layer).keys() - self._kept(layer) - saved.keys():
                delattr(layer, name)
            vars(layer).update(saved)

    def _places(self):
        """Where layers, and functions that they hold, are: one goes where it was. And all cells of those functions."""
        places, cells, seen = {}, [], set()

        def add(place, it):
            if isinstance(it, types.FunctionType) and id(it) not in seen:
                seen.add(id(it))
                places[place] = it
                for number, cell in enumerate(it.__closure__ or ()):
                    cells.append(cell)
                    add((*place, number), cell.cell_contents)

        for number, layer in enumerate(self.layers):
            places[number,] = layer
            for name, value in sorted(vars(layer).items()):
                if name not in self._kept(layer):
                    add((number, name), value)
        return places, cells


class Emulator:
    """ALE's emulator: its state before the episode, and the actions since.

    Its state of this moment would not do: in it are neither the action that it may repeat nor, in some games, all of the picture. The
    reset that begins an episode sets both, and so the episode is played again.
    """

    def __init__(self, ale):
        self.ale, self.before, self.first_frame, self.actions = ale, None, 0, []
        self.take, self.record = ale.act, self.actions.append
        # All else that it can do, found without a detour.
        vars(self).update({name: getattr(ale, name) for name in dir(ale) if not name.startswith("_") and not hasattr(Emulator, name)})

    def reset_game(self):
        self.before = self.ale.cloneState(include_rng=True)
        self.actions.clear()
        self.ale.reset_game()
        self.first_frame = self.ale.getEpisodeFrameNumber()  # Not 0 where the game is chosen with a key.

    def act(self, action, strength=1.0):
        if strength != 1.0:
            self.before = None
        self.record(action)
        return self.take(action, strength)

    def restoreState(self, state):
        self.before = None
        self.ale.restoreState(state)

    def save(self):
        if self.before is None or self.ale.getEpisodeFrameNumber() != self.first_frame + len(self.actions):
            raise NotSaved("ALE's emulator was not only reset and given actions since the episode began")
        return self.before, bytes(action.value for action in self.actions)

    def load(self, before, actions):
        import ale_py

        self.ale.restoreState(before)
        self.reset_game()
        for action in actions:
            self.act(ale_py.Action(action))


class Pickler(pickle.Pickler):
    """Leaves in its place what has one, and refuses what would not come back as it is."""

    def __init__(self, file, places):
        super().__init__(file)
        self.places = places
        self.memory = set()

    def persistent_id(self, it):
        return self.places.get(id(it))

    def reducer_override(self, it):
        from gymnasium import Env, utils, vector

        if isinstance(it, types.ModuleType):
            return importlib.import_module, (it.__name__,)
        if isinstance(it, (Env, vector.VectorEnv, utils.EzPickle)):
            # Copied, it would be one that begins anew.
            raise NotSaved(f"it holds a {type(it).__name__} that is not what it wraps; give it save_state and load_state")
        if isinstance(it, sys.modules["numpy"].ndarray):
            while getattr(it, "base", None) is not None:
                it = it.base
            if id(it) in self.memory:  # Copied, each would have its own.
                raise NotSaved("it holds two arrays that share memory; give it save_state and load_state")
            self.memory.add(id(it))
        return NotImplemented


class Unpickler(pickle.Unpickler):
    def __init__(self, file, places):
        super().__init__(file)
        self.places = places

    def persistent_load(self, place):
        return self.places[place]


def offers_state(layer):
    return hasattr(type(layer), "save_state") and hasattr(type(layer), "load_state")


def is_ale(layer):
    return type(layer).__module__.startswith("ale_py.") and hasattr(vars(layer).get("ale"), "act")


def made_with():
    names = [name for name in ("gymnasium", "numpy", "ale_py") if name in sys.modules]
    return {"python": platform.python_version()} | {name: sys.modules[name].__version__ for name in names}


def takes_copies(make):
    """Whether it gives a vector of as many copies as it is told."""
    needed = lambda it: it.default is it.empty and it.kind in (it.POSITIONAL_ONLY, it.POSITIONAL_OR_KEYWORD)
    return any(needed(it) or it.name in ("copies", "num_envs") for it in inspect.signature(make).parameters.values())


def maker(args):
    """What makes the environment that the command line asks for."""
    sys.path.append(os.getcwd())
    imports = args.imports + ["ale_py"] * args.env.startswith("ALE/")
    for module in imports:
        importlib.import_module(module)
    if ":" in args.env:  # A function of one's own; `MODULE:ID` of Gymnasium is `--import MODULE ID` here.
        module, function = args.env.split(":", 1)
        unused = [flag for flag in ("atari", "clip", "pixels", "size", "grey") if getattr(args, flag)] + ["kwargs"] * (args.kwargs != "{}")
        if unused:
            sys.exit(f"--{unused[0]} is for an id of Gymnasium, and {args.env} makes its environment itself: leave it out, and wrap the environment in {function}")
        return getattr(importlib.import_module(module), function)
    import gymnasium
    from gymnasium import wrappers

    options = json.loads(args.kwargs)
    if args.atari:  # Every frame of the emulator is asked for, and four of them made one step here.
        options = {"frameskip": 1, "repeat_action_probability": 0.25} | options
    if args.pixels:
        options = {"render_mode": "rgb_array"} | options

    def make():
        for module in imports:  # A worker may be an interpreter that has not imported them.
            importlib.import_module(module)
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
    parser.add_argument("env", help="an id such as ALE/Pong-v5, or MODULE:FUNCTION: a function without required arguments that gives an environment, or with one, the number of copies, that gives a vector environment")
    parser.add_argument("--atari", action="store_true", help="Dopamine's preprocessing")
    parser.add_argument("--clip", action="store_true", help="clip rewards to -1..1, as Dopamine's agents do; returns are sums of clipped rewards")
    parser.add_argument("--pixels", action="store_true", help="use the frames that the environment renders")
    parser.add_argument("--size", type=int, metavar="N", help="resize frames to N x N")
    parser.add_argument("--grey", action="store_true", help="convert frames to grey")
    parser.add_argument("--channels", choices=("first", "last"), help="where frames have their channels, if they are not fewer than rows and columns")
    parser.add_argument("--kwargs", default="{}", metavar="JSON", help="arguments of gymnasium.make")
    parser.add_argument("--import", dest="imports", action="append", default=[], metavar="MODULE", help="module that registers the environment")
    parser.add_argument("--workers", action="store_true", help="run each copy in its own process")
    return parser


def main():
    args = parser().parse_args()
    try:
        serve(lambda copies: Gymnasium(maker(args), copies, args.workers, args.channels))
    except ModuleNotFoundError as missing:
        package = {"gymnasium": "gymnasium", "numpy": "numpy", "ale_py": "ale-py"}.get(missing.name)
        if not package:
            raise
        sys.exit(f"driml_env.py needs the package {package}: {sys.executable} -m pip install {package}")


if __name__ == "__main__":
    main()
