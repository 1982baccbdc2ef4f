"""Frames through the policy in PyTorch, forward only, without gradients: bytes in, greedy actions out.

It is the same work as `driml bench policy`: the same network on the same numbers of frames. Of PyTorch's two memory formats
the faster one is taken for each; beside our bf16 stands the faster of f32 and bf16 autocast.
"""

import sys

import torch

import measure
from torch_update import CONFIG, FORMATS, IMPALA, NARROW, NATURE, of

NETWORKS = {
    "64x64x3": ((64, 64), NATURE),
    "104x80x3": ((104, 80), NATURE),
    "64x64x3, impala": ((64, 64), IMPALA),
    "64x64x3, impala, half width": ((64, 64), NARROW),
}
BATCHES = (32, 256)


@torch.inference_mode()
def rate(effort, network, frames, memory_format, bf16):
    network.to(memory_format=memory_format)

    def act():
        images = frames.permute(0, 3, 1, 2).contiguous(memory_format=memory_format)
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            values = network.expected_returns(network.logits_of(network.features_of_images(images)[1]))
        values.argmax(1).numpy()

    return effort.rate_by_median(act)


def main():
    args = measure.parser(__doc__).parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(1)
    effort, figures, formats = measure.Effort(args.quick), {}, set()
    for name, ((height, width), torso) in NETWORKS.items():
        obs = {"height": height, "width": width, "channels": 3}
        network = of(dict(CONFIG, obs=obs, model=CONFIG["model"] | torso))
        for batch in BATCHES:
            frames = torch.randint(0, 256, (batch, height, width, 3), dtype=torch.uint8)
            what, rates = f"{batch} frames of {name}", {}
            for bf16 in (False, True):
                for form, memory_format in FORMATS.items():
                    form += ", bf16 autocast" if bf16 else ""
                    rates[form] = batch * rate(effort, network, frames, memory_format, bf16)
                    print(f"  {what}, {form}: {rates[form]:.4g} frames/s", file=sys.stderr, flush=True)
                best = max(rates, key=rates.get)
                figures[what + (", bf16" if bf16 else "")] = rates[best]
                formats.add(best)
    measure.report(f"PyTorch {torch.__version__}, {' or '.join(sorted(formats))}", figures)


if __name__ == "__main__":
    main()
