"""Transitions into Reverb and batches out of it: one client with 8 environments, a server in a process of its own.

It is the same work as `driml bench replay`: the same frames (real ones, from a file), each sent and stored once, in a table
of 20,000 items; inserts count when the server has confirmed them; every cache line of a batch is read. What differs is what
Reverb cannot do: k is not drawn when a batch is sampled. So there are two kinds of items, each measured against it:
 - s_t, s_{t+1}, s_{t+7}: as many frames as ours sends, with a k that was fixed at the insert;
 - s_t .. s_{t+7}: a sequence, from which a client may choose k itself.
"""

import importlib.metadata
import itertools
import os
import socket
import subprocess
import sys
import time

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import numpy
import reverb
import tensorflow

import measure

STREAMS, FRAME = 8, (60, 60, 3)  # what driml keeps and sends of a frame of 64 x 64: the part that a convolution reads
CAPACITY = 20_000
ROWS = 256
SPAN = 8
ITEMS = {"batch of 3 states": [-8, -7, -1], "batch of sequences of 8 states": slice(-8, None)}
WORKERS = 2
# Steps of all streams between two waits for the server's confirmations: as many items as an actor of ours has on their way.
STEPS_PER_FLUSH = 128


def serve(port):
    """The server's process: a table for each kind of item."""
    scalars = {"action": tensorflow.uint8, "reward": tensorflow.float32, "end": tensorflow.uint8}

    def table(name, frames):
        signature = {key: tensorflow.TensorSpec((SPAN,), dtype) for key, dtype in scalars.items()}
        signature["frame"] = tensorflow.TensorSpec((frames, *FRAME), tensorflow.uint8)
        return reverb.Table(
            name,
            sampler=reverb.selectors.Uniform(),
            remover=reverb.selectors.Fifo(),
            max_size=CAPACITY,
            rate_limiter=reverb.rate_limiters.MinSize(1),
            signature=signature,
        )

    tables = [table(name, 3 if isinstance(frames, list) else SPAN) for name, frames in ITEMS.items()]
    server = reverb.Server(tables, port=port)
    print("listening", flush=True)
    sys.stdin.read()  # Ends with the process that started this one.
    server.stop()


def start_server():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = subprocess.Popen(
        [sys.executable, __file__, "--serve", str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    if server.stdout.readline().strip() != "listening":
        sys.exit("the server did not start")
    return server, f"127.0.0.1:{port}"


def insert(client, table, recording, is_enough):
    """Steps all streams until `is_enough` of what was inserted and since when; items confirmed a second."""
    writers = [client.trajectory_writer(num_keep_alive_refs=SPAN) for _ in range(STREAMS)]
    action, reward, end = numpy.uint8(1), numpy.float32(0.5), numpy.uint8(0)
    started, inserted = time.perf_counter(), 0
    for step in itertools.count():
        for stream, writer in enumerate(writers):
            frame = recording[step % len(recording), stream]
            writer.append({"frame": frame, "action": action, "reward": reward, "end": end})
            if step + 1 >= SPAN:
                history = writer.history
                item = {name: history[name][-SPAN:] for name in ("action", "reward", "end")}
                item["frame"] = history["frame"][ITEMS[table]]
                writer.create_item(table, 1.0, item)
                inserted += 1
        if (step + 1) % STEPS_PER_FLUSH == 0:
            for writer in writers:
                writer.flush()
            if is_enough(inserted, started):
                break
    rate = inserted / (time.perf_counter() - started)
    for writer in writers:
        writer.close()
    return rate


def batches(address, table, effort):
    """Batches a second."""
    dataset = reverb.TrajectoryDataset.from_table_signature(
        address, table, max_in_flight_samples_per_worker=2 * ROWS, num_workers_per_iterator=WORKERS
    )
    samples = iter(dataset.batch(ROWS, drop_remainder=True).prefetch(2))

    def fetch():
        numpy.asarray(next(samples).data["frame"]).reshape(-1)[::64].sum(dtype=numpy.uint64)

    return effort.rate_overall(fetch)


def main():
    arguments = measure.parser(__doc__)
    arguments.add_argument("--frames", help=f"raw bytes [steps, {STREAMS}, {FRAME}]")
    arguments.add_argument("--serve", type=int, metavar="PORT", help="be the server; for the script itself")
    args = arguments.parse_args()
    if args.serve:
        return serve(args.serve)
    if not args.frames:
        arguments.error("--frames is needed; `driml bench peers` gives it")
    effort, figures = measure.Effort(args.quick), {}
    recording = numpy.fromfile(args.frames, numpy.uint8).reshape(-1, STREAMS, *FRAME)
    server, address = start_server()
    try:
        client = reverb.Client(address)
        for table in ITEMS:
            insert(client, table, recording, lambda inserted, _: inserted >= CAPACITY)
            if table == "batch of 3 states":
                rate = insert(client, table, recording, lambda _, started: effort.is_spent(started))
                measure.found(figures, "insert", rate, "transitions/s")
            measure.found(figures, table, batches(address, table, effort), "batches/s")
    finally:
        server.kill()
    measure.report(f"Reverb {importlib.metadata.version('dm-reverb')}", figures)


if __name__ == "__main__":
    main()
