"""Rows drawn uniformly and by priority from Reverb, and their priorities set: beside `driml bench replay --sampling --held N`.

Items have 64 bytes and nothing else, so that the draw is measured and not the copying of states; many share them, so that a table is
full within minutes. Server and client are one process, in which Reverb looks into its tables directly, without gRPC, as ours is measured
in the core of the replay server. What cannot be made the same: Reverb's client is Python, a call for each sampled item.
"""

import importlib.metadata
import os
import random

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import numpy
import reverb

import measure

ROWS = 256
ALPHA = 0.5


def table(name, sampler, held):
    return reverb.Table(
        name,
        sampler=sampler,
        remover=reverb.selectors.Fifo(),
        max_size=held,
        rate_limiter=reverb.rate_limiters.MinSize(1),
    )


def fill(client, held):
    """The same items into every table."""
    frame = numpy.zeros(64, numpy.uint8)
    with client.trajectory_writer(num_keep_alive_refs=1) as writer:
        for item in range(held):
            if item % 100 == 0:
                writer.append({"frame": frame})
                trajectory = {"frame": writer.history["frame"][-1:]}
            for name in ("uniform", "prioritised"):
                writer.create_item(name, random.random(), trajectory)
            if item % 1000 == 999:
                writer.flush(block_until_num_items=200)


def main():
    arguments = measure.parser(__doc__)
    arguments.add_argument("--held", type=int, default=20_000, metavar="N", help="items of a table")
    args = arguments.parse_args()
    effort, figures = measure.Effort(args.quick), {}
    selectors = {
        "uniform": reverb.selectors.Uniform(),
        "prioritised": reverb.selectors.Prioritized(priority_exponent=ALPHA),
    }
    server = reverb.Server([table(name, it, args.held) for name, it in selectors.items()])
    client = reverb.Client(f"localhost:{server.port}")
    fill(client, args.held)
    found = {}

    def draw(name):
        found[name] = [sample[0].info.key for sample in client.sample(name, ROWS)]

    def set_priorities():
        draw("prioritised")
        updates = {key: random.random() for key in found["prioritised"]}
        client.mutate_priorities("prioritised", updates=updates)

    of = f"{ROWS} rows of {args.held} items"
    for name, work in [
        ("drawn uniformly", lambda: draw("uniform")),
        ("drawn by priority", lambda: draw("prioritised")),
        ("drawn by priority, and priorities set", set_priorities),
    ]:
        measure.found(figures, f"{of} {name}", effort.rate_by_median(work), "batches/s")
    server.stop()
    measure.report(f"Reverb {importlib.metadata.version('dm-reverb')}", figures)


if __name__ == "__main__":
    main()
