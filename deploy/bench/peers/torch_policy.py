"""Frames through the policy in PyTorch, forward only, without gradients: bytes in, greedy actions out.

It is the same work as `driml bench policy`: the same network on the same numbers of frames. Of PyTorch's two memory formats
the faster one is taken for each; beside our bf16 stands the faster of f32 and bf16 autocast.
"""

import sys

import torch

import measure
from torch_network import Network
from torch_update import CONFIG, FORMATS

SIZES = ((64, 64), (104, 80))
BATCHES = (32, 256)


@torch.inference_mode()
def rate(effort, network, frames, memory_format, bf16):
    network.to(memory_format=memory_format)

    def act():
        images = frames.permute(0, 3, 1, 2).contiguous(memory_format=memory_format)
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            values = network.q_values(network.logits(network.features(images)[1]))
        values.argmax(1).numpy()

    return effort.rate_by_median(act)


def main():
    args = measure.parser(__doc__).parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(1)
    effort, figures, formats = measure.Effort(args.quick), {}, set()
    for height, width in SIZES:
        network = Network(dict(CONFIG, obs={"height": height, "width": width, "channels": 3}))
        for batch in BATCHES:
            frames = torch.randint(0, 256, (batch, height, width, 3), dtype=torch.uint8)
            what, rates = f"{batch} frames of {height}x{width}x3", {}
            for bf16 in (False, True):
                for name, memory_format in FORMATS.items():
                    name += ", bf16 autocast" if bf16 else ""
                    rates[name] = batch * rate(effort, network, frames, memory_format, bf16)
                    print(f"  {what}, {name}: {rates[name]:.4g} frames/s", file=sys.stderr, flush=True)
                best = max(rates, key=rates.get)
                figures[what + (", bf16" if bf16 else "")] = rates[best]
                formats.add(best)
    measure.report(f"PyTorch {torch.__version__}, {' or '.join(sorted(formats))}", figures)


if __name__ == "__main__":
    main()
