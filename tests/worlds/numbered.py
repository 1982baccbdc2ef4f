"""A world whose every frame says which one it is: what an actor records can be held against what happened. Needs Python alone.

A frame is 12 x 12 x 1 bytes, all of them the number of the copy's step in its episode, but for the first four: the copy, the
episode (counted from 0), and the two halves of the copy's seed modulo 65,536. Copy i has episodes of 3 + i steps: even ones end,
odd ones time out. The reward is the action plus the step divided by 100, and 1000 in the last step.

`numbered.py FAULT STEP`: what goes wrong in a step of that number, counted from 1. `numbered.py saves FAULT`: it offers to save its
state, and what goes wrong then.
"""

import json, os, sys, time

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "../../deploy/python"))
import driml_env
from driml_env import RUNNING, TERMINAL, TIMED_OUT, NotSaved, serve

FAULT, STEP = (sys.argv + ["none", "0"])[1:3]


class Numbered:
    height = width = 12
    channels = 1
    actions = ["no-op", "left", "right"]

    def __init__(self, copies):
        print("a line on stdout does no harm", flush=True)
        self.copies, self.steps_of_all = copies, 0

    def reset(self, seeds):
        self.seeds = [seed % 65536 for seed in seeds]
        self.steps, self.episodes = [0] * self.copies, [0] * self.copies
        return self.frames()

    def frames(self):
        frames = bytearray()
        for copy in range(self.copies):
            frame = bytearray([self.steps[copy] % 256]) * (12 * 12)
            frame[:4] = bytes([copy % 256, self.episodes[copy] % 256, self.seeds[copy] // 256, self.seeds[copy] % 256])
            frames += frame
        return frames

    def step(self, actions):
        self.steps_of_all += 1
        if str(self.steps_of_all) == STEP:
            fail()
        rewards, ends = [], []
        for copy, action in enumerate(actions):
            self.steps[copy] += 1
            end = RUNNING
            if self.steps[copy] == 3 + copy:
                end = TIMED_OUT if self.episodes[copy] % 2 else TERMINAL
            rewards.append(1000.0 if end else action + self.steps[copy] / 100)
            ends.append(end)
            if end:
                self.steps[copy], self.episodes[copy] = 0, self.episodes[copy] + 1
        if str(self.steps_of_all) == STEP and FAULT == "nan":
            rewards[1] = float("nan")
        if str(self.steps_of_all) == STEP and FAULT == "end":
            ends[1] = 7
        return rewards, ends, self.frames()


def fail():
    if FAULT == "raise":
        raise RuntimeError("the dragon got out")
    if FAULT == "kill":
        os.kill(os.getpid(), 9)
    if FAULT == "hang":
        print("sleeping", file=sys.stderr, flush=True)
        time.sleep(3600)
    if FAULT == "small":
        Numbered.frames = lambda self: b"few bytes"


class Saved(Numbered):
    def save_state(self):
        if STEP == "never":
            raise NotSaved("the dragon sits on it")
        if STEP == "raise":
            raise RuntimeError("the dragon ate it")
        if STEP == "hang":
            time.sleep(3600)
        return json.dumps([self.seeds, self.steps, self.episodes, self.steps_of_all]).encode()

    def load_state(self, state):
        if STEP == "lost":
            sys.exit("the dragon does not give it back")
        self.seeds, self.steps, self.episodes, self.steps_of_all = json.loads(state)


def wrong_answer(world, place):
    """What no `serve` does."""
    if STEP == "large":
        os.truncate(place["state"], place["bytes_max"] + 1)
    return b"?" if STEP == "byte" else b"."


if __name__ == "__main__":
    if STEP in ("large", "byte", "nothing"):
        driml_env.save = wrong_answer
    serve(Saved if FAULT == "saves" else Numbered)
