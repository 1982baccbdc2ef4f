"""What all peers' scripts share: the command line, how long a thing is measured, and the one line of JSON at the end.

The rules are those of deploy/machine/src/speed_meter.rs, so that both sides are measured alike.
"""

import argparse
import json
import statistics
import sys
import time


def parser(text):
    """A command line with what every script takes."""
    arguments = argparse.ArgumentParser(description=text)
    arguments.add_argument("--quick", action="store_true", help="a few iterations only")
    arguments.add_argument("--threads", type=int, default=2, help="threads for arithmetic [default: 2]")
    return arguments


class Effort:
    """How long each thing is measured."""

    def __init__(self, quick):
        self.warmup_calls, self.calls_min, self.seconds_min = (1, 2, 0.2) if quick else (2, 3, 4.0)

    def rate_by_median(self, work):
        """Calls a second by the median of their durations: for calls that all do the same."""
        return 1 / statistics.median(self._durations(work))

    def rate_overall(self, work):
        """Calls a second over all of them: for calls of which a few do much more than the others."""
        durations = self._durations(work)
        return len(durations) / sum(durations)

    def is_spent(self, started):
        return time.perf_counter() - started >= self.seconds_min

    def _durations(self, work):
        for _ in range(self.warmup_calls):
            work()
        first, durations = time.perf_counter(), []
        while len(durations) < self.calls_min or not self.is_spent(first):
            started = time.perf_counter()
            work()
            durations.append(time.perf_counter() - started)
        return durations


def found(figures, what, value, unit):
    """Keeps a figure and tells whoever watches."""
    figures[what] = value
    print(f"  {what}: {value:.4g} {unit}", file=sys.stderr, flush=True)


def report(peer, figures):
    """The line that `driml bench peers` reads."""
    print(json.dumps({"peer": peer, "figures": figures}), flush=True)
