"""Checks driml_env.py's adapter with an environment of which every observation says which one it is. Needs Gymnasium and ALE.

`check_adapter.py --games`: whether each of ALE's games goes on as it was saved, with Dopamine's preprocessing.
"""

import multiprocessing, os, random, sys

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "../../deploy/python"))
import driml_env
import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

STEPS = (3, 4)  # Of episodes in turn: the first kind terminates, the second is truncated.


class Numbered(gymnasium.Env):
    """Observations [seed, episode, step, action] in a frame of 2 x 2; the reward is the step."""

    observation_space = gymnasium.spaces.Box(0, 255, (2, 2), np.uint8)
    action_space = gymnasium.spaces.Discrete(3, start=5)

    def __init__(self):
        self.episode, self.seed = -1, 0

    def observation(self, action):
        return np.array([[self.seed, self.episode], [self.step_number, action]], np.uint8)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.seed = seed
        self.episode, self.step_number = self.episode + 1, 0
        return self.observation(0), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.step_number += 1
        kind = self.episode % 2
        over = self.step_number == STEPS[kind]
        return self.observation(action), self.step_number, over and kind == 0, over and kind == 1, {}


class ChannelsFirst(Numbered):
    observation_space = gymnasium.spaces.Box(0, 255, (3, 32, 20), np.uint8)

    def observation(self, action):
        return np.arange(3 * 32 * 20, dtype=np.uint32).reshape(3, 32, 20).astype(np.uint8)


class Holding(Numbered):
    """Its attributes have the names under which wrappers and vectors keep what they hold."""

    def __init__(self):
        super().__init__()
        self.env, self.envs = None, 3


def check_episodes(world):
    assert (world.height, world.width, world.channels, world.actions) == (2, 2, 1, ["0", "1", "2"])
    copies = 2
    frames = bytes(world.reset([11, 12]))
    episode = step = action = 0
    for number in range(50):
        expected = [[seed, episode, step, action] for seed in (11, 12)]
        assert list(frames) == sum(expected, []), (number, list(frames), expected)
        rewards, ends, frames = world.step(bytes([number % 3] * copies))
        frames, step, action = bytes(frames), step + 1, 5 + number % 3
        over = step == STEPS[episode % 2]
        assert list(rewards) == [step] * copies, (number, rewards)
        end = (driml_env.TIMED_OUT if episode % 2 else driml_env.TERMINAL) if over else driml_env.RUNNING
        assert bytes(ends) == bytes([end] * copies), (number, ends)
        if over:  # The frame is the first of the next episode, in the same step.
            episode, step, action = episode + 1, 0, 0


def check_refused(word, make):
    try:
        driml_env.Gymnasium(make, 2)
    except SystemExit as said:
        assert word in str(said), said
    else:
        raise AssertionError(f"{word!r} was not said")


class Chance(Numbered):
    """Frames of chance: by its own generator, by one of Python's, and by what the episodes before were."""

    def __init__(self):
        super().__init__()
        self.before = {"steps": [np.zeros(3, np.int64)]}

    def observation(self, action):
        self.before["steps"][0] += action + 1
        drawn = [self.np_random.integers(256), random.randrange(256), self.before["steps"][0].sum() % 256, self.step_number]
        return np.array(drawn, np.uint8).reshape(2, 2)


class Own(Chance):
    """It says itself how it stands, though `pickle` would not copy it."""

    def __init__(self):
        super().__init__()
        self.open = (number for number in range(3))

    def save_state(self):
        return repr((self.np_random.bit_generator.state, self.episode, self.step_number, list(map(int, self.before["steps"][0])))).encode()

    def load_state(self, state):
        self.np_random.bit_generator.state, self.episode, self.step_number, steps = eval(state)
        self.before["steps"][0][:] = steps


def wrapped():
    """A time limit, and a reward that a function without a name counts."""
    count = 0

    def reward(earned):
        nonlocal count
        count += 1
        return earned + count

    return gymnasium.wrappers.TransformReward(gymnasium.wrappers.TimeLimit(Chance(), 3), reward)


def ale(*arguments, game="ALE/Breakout-v5"):
    return driml_env.maker(driml_env.parser().parse_args([game, *arguments]))


def check_games():
    import ale_py

    gymnasium.register_envs(ale_py)
    games = sorted(name for name in gymnasium.registry if name.startswith("ALE/") and name.endswith("-v5"))
    for game in games:
        check_saved(ale("--atari", game=game), moves=False)
        print(game, "goes on", flush=True)
    print(len(games), "games go on as they were saved")


def meddled():
    """Its emulator is put back without a reset."""

    class Meddled(gymnasium.Wrapper):
        def reset(self, **how):
            first = self.env.reset(**how)
            self.unwrapped.restore_state(self.unwrapped.clone_state())
            return first

    return Meddled(ale()())


def check_saved(make, steps=60, moves=True):
    saver, other = driml_env.Gymnasium(make, 2), driml_env.Gymnasium(make, 2)
    draw = np.random.default_rng(3)
    actions = lambda: bytes(draw.integers(0, len(saver.actions), 2, np.uint8))
    saver.reset([1, 2])
    [saver.step(actions()) for _ in range(5)]
    other.reset([3, 4])
    [other.step(actions()) for _ in range(8)]
    later = [[actions() for _ in range(steps)] for _ in range(2)]
    state = saver.save_state()
    goes_on = lambda world, chosen: [[bytes(np.asarray(it)) for it in world.step(them)] for them in chosen]
    first, second = goes_on(saver, later[0]), goes_on(saver, later[1])
    before = goes_on(other, later[0])
    # Else what is checked below says nothing.
    assert not moves or first != second and first != before
    other.load_state(state)
    assert goes_on(other, later[0]) == first
    # It goes on from a state of one that had loaded one.
    other.load_state(other.save_state())
    assert goes_on(other, later[1]) == second


def check_not_saved(word, make):
    world = driml_env.Gymnasium(make, 2)
    world.reset([1, 2])
    try:
        world.save_state()
    except driml_env.NotSaved as said:
        assert word in str(said), said
    else:
        raise AssertionError(f"{word!r} was not said")


def check_foreign(word, saver, loader):
    saver, loader = driml_env.Gymnasium(saver, 2), driml_env.Gymnasium(loader, 2)
    saver.reset([1, 2]), loader.reset([1, 2])
    try:
        loader.load_state(saver.save_state())
    except SystemExit as said:
        assert word in str(said), said
    else:
        raise AssertionError(f"{word!r} was not said")


def holding(what):
    def make():
        env = Chance()
        env.held = what(env)
        return env

    return make


def vector(mode, kind=SyncVectorEnv):
    return lambda copies: kind([Numbered] * copies, autoreset_mode=mode)


def by_default(render_mode=None):
    """As Gymnasium's own environments have it."""
    return Numbered()


def check_own_functions():
    """What a function of one's own is called with, and what has no effect on it; in the current folder, as what `--import` names."""
    check_episodes(driml_env.Gymnasium(by_default, 2))
    named = lambda copies=1: SyncVectorEnv([Numbered] * copies, autoreset_mode=AutoresetMode.SAME_STEP)
    check_episodes(driml_env.Gymnasium(named, 2))
    os.chdir(os.path.dirname(os.path.abspath(__file__)))
    args = driml_env.parser().parse_args(["check_adapter:by_default", "--import", "check_adapter", "--clip"])
    try:
        driml_env.maker(args)
    except SystemExit as said:
        assert "--clip is for an id of Gymnasium" in str(said), said
    else:
        raise AssertionError("--clip has no effect")
    args.clip = False
    check_episodes(driml_env.Gymnasium(driml_env.maker(args), 2))


def with_spaces(**spaces):
    return lambda: type("Other", (Numbered,), spaces)()


if __name__ == "__main__":
    if sys.argv[1:] == ["--games"]:
        sys.exit(check_games())
    check_episodes(driml_env.Gymnasium(lambda: Numbered(), 2))
    check_episodes(driml_env.Gymnasium(lambda: Numbered(), 2, workers=True))
    check_episodes(driml_env.Gymnasium(vector(AutoresetMode.SAME_STEP), 2))
    check_episodes(driml_env.Gymnasium(vector(AutoresetMode.DISABLED), 2))
    check_episodes(driml_env.Gymnasium(vector(AutoresetMode.SAME_STEP, AsyncVectorEnv), 2))
    check_own_functions()
    # Workers that are new interpreters have imported nothing, and ALE's own vectors have another emulator.
    multiprocessing.set_start_method("forkserver", force=True)
    driml_env.Gymnasium(ale("--atari"), 2, workers=True).reset([1, 2])
    own = lambda copies: sys.modules["ale_py"].AtariVectorEnv("pong", copies, autoreset_mode=AutoresetMode.SAME_STEP)
    check_not_saved("", own)
    check_refused("SAME_STEP", vector(AutoresetMode.NEXT_STEP))
    check_refused("has 3 copies, and driml asked for 2", lambda copies: SyncVectorEnv([Numbered] * 3, autoreset_mode=AutoresetMode.SAME_STEP))
    floats, nine = gymnasium.spaces.Box(0, 1, (4,), np.float32), gymnasium.spaces.Box(0, 1, (9,), np.float32)
    check_refused("learns from frames", with_spaces(observation_space=floats))
    check_refused("Discrete", with_spaces(action_space=nine))
    world = driml_env.Gymnasium(lambda: ChannelsFirst(), 2)
    assert (world.height, world.width, world.channels) == (32, 20, 3)
    frames = np.frombuffer(bytes(world.reset([1, 2])), np.uint8).reshape(2, 32, 20, 3)
    assert (frames[1] == np.moveaxis(ChannelsFirst().observation(0), 0, -1)).all()
    frames_of = lambda *shape: with_spaces(observation_space=gymnasium.spaces.Box(0, 255, shape, np.uint8))
    for shape, channels, expected in [
        ((3, 12, 12), None, (12, 12, 3)),
        ((12, 12, 11), None, (12, 12, 11)),
        ((12, 10, 1), None, (12, 10, 1)),
        ((9, 9, 9), "last", (9, 9, 9)),
        ((4, 3, 5), "first", (3, 5, 4)),
        ((1, 5), "first", (1, 5, 1)),
    ]:
        world = driml_env.Gymnasium(frames_of(*shape), 2, channels=channels)
        assert (world.height, world.width, world.channels) == expected, (shape, channels)
    check_refused("add --channels first or --channels last", frames_of(9, 9, 9))
    for make in (Numbered, Holding, Chance, Own, wrapped, lambda: Chance(), ale("--atari"), ale("--atari", "--clip", "--size", "40")):
        check_saved(make)
    check_saved(ale("--grey", "--size", "64"))
    check_saved(lambda: gymnasium.make("ALE/Pong-v5", frameskip=(2, 5)))
    for mode in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):
        check_saved(lambda copies: SyncVectorEnv([wrapped] * copies, autoreset_mode=mode))
    check_not_saved("leave --workers out", vector(AutoresetMode.SAME_STEP, AsyncVectorEnv))
    check_not_saved("generator", holding(lambda env: (number for number in range(3))))
    check_not_saved("holds a Chance", holding(lambda env: [Chance()]))
    check_not_saved("share memory", holding(lambda env: [array := np.zeros(9), array[3:]]))
    check_not_saved("not only reset and given actions", meddled)
    check_foreign("this one has no", wrapped, Chance)
    check_foreign("it has 3 environments and wrappers, this one 7", Chance, wrapped)
