#!/usr/bin/env python3
"""What each thing costs that is, or could be, rounded to bf16: the error of an update's gradients, one choice at a time.

Needs PyTorch and safetensors, as make_cases.py, whose network and losses it takes. Everything but what a row names is float64, so
that a row is the error of that choice alone. Sums of products are float64 too: f32's share is its own row.

    python3 rounding.py [--rows N] [--steps N]     prints the table of deploy/docs/src/explanation/numerics.md in full
"""

import argparse
import contextlib
import json

import torch
import torch.nn.functional as F
from safetensors import safe_open

import make_cases as cases

# The open cases of C51 with DIM; the full-size one is made here.
FILES = ["all_four", "c51_only", "double_dqn_clipped", "global_global", "masked_positives", "no_action"]
# Gradients of tensors that are a tenth of the global one or more, as `driml parity --precision bf16` looks at.
SHARE_MIN = 0.1


# --- Rounding ------------------------------------------------------------------------------------------------------------


def rounded(x):
    """The nearest bf16, ties to even."""
    return x.float().bfloat16().to(x.dtype)


class Value(torch.autograd.Function):
    """Rounds on the way forward; the gradient passes."""

    @staticmethod
    def forward(ctx, x):
        return rounded(x)

    @staticmethod
    def backward(ctx, g):
        return g


class Gradient(torch.autograd.Function):
    """Rounds the gradient on the way back; the value passes."""

    @staticmethod
    def forward(ctx, x):
        return x.view_as(x)

    @staticmethod
    def backward(ctx, g):
        return rounded(g)


class Rounds:
    """The functions of torch.nn.functional that make_cases takes, with the operands of `chosen` rounded.

    A choice is "PLACE WHAT": places are torso, c51, dim and info_nce, what is weights, activations, gradients or results.
    """

    def __init__(self, chosen):
        self.chosen = chosen
        self.place = "torso"

    def __getattr__(self, name):
        return getattr(F, name)

    def value(self, x, what):
        return Value.apply(x) if f"{self.place} {what}" in self.chosen else x

    def result(self, y):
        y = Gradient.apply(y) if f"{self.place} gradients" in self.chosen else y
        return self.value(y, "results")

    def linear(self, x, w, b=None):
        y = self.result(F.linear(self.value(x, "activations"), self.value(w, "weights")))
        # A bias is added to the sum in f32, and its gradient is the sum of gradients that are not rounded.
        return y if b is None else y + b

    def conv2d(self, x, w, b, stride):
        if "pixels" in self.chosen and x.shape[1] == 3:
            x = rounded(x)
        # Pixels are no activations: as whole numbers they are bf16 already, and are scaled after the sum.
        x = x if x.shape[1] == 3 else self.value(x, "activations")
        return self.result(F.conv2d(x, self.value(w, "weights"), stride=stride)) + b.view(-1, 1, 1)


@contextlib.contextmanager
def rounding(chosen):
    """make_cases with the operands of `chosen` rounded."""
    rounds, kept = Rounds(chosen), {name: getattr(cases, name) for name in ["F", "distribution", "block", "info_nce", "torch"]}

    def at(place, function):
        def there(*args):
            before, rounds.place = rounds.place, place
            try:
                return function(*args)
            finally:
                rounds.place = before

        return there

    class Torch:
        """Its einsum is that of the dot products."""

        def __getattr__(self, name):
            return getattr(torch, name)

        @staticmethod
        def einsum(equation, a, b):
            return at("info_nce", lambda: rounds.result(torch.einsum(equation, *(rounds.value(x, "activations") for x in (a, b)))))()

    cases.F, cases.torch = rounds, Torch()
    cases.distribution, cases.block = at("c51", kept["distribution"]), at("dim", kept["block"])
    try:
        yield
    finally:
        for name, value in kept.items():
            setattr(cases, name, value)


# --- The choices ---------------------------------------------------------------------------------------------------------

OPERANDS = ["weights", "activations", "gradients"]
PLACES = {"torso": "torso", "c51": "C51 head", "dim": "DIM's heads"}
# What `Precision::Bf16` rounds.
BF16 = {f"{place} {what}" for place in PLACES for what in OPERANDS}
DOTS = {"info_nce activations", "info_nce gradients"}

CHOICES = [(f"{name}: {what}", {f"{place} {what}"}) for place, name in PLACES.items() for what in OPERANDS] + [
    ("**all of these: bf16 as it is**", BF16),
    ("pixels / 255 (bf16 as it is: bytes, scaled after the sum)", {"pixels"}),
    ("InfoNCE: vectors whose dot products are taken", {"info_nce activations"}),
    ("InfoNCE: gradients of dot products", {"info_nce gradients"}),
    ("InfoNCE: dot products, as they are stored", {"info_nce results"}),
    ("C51: logits, as they are stored", {"c51 results"}),
    ("bf16 as it is, and pixels / 255", BF16 | {"pixels"}),
    ("bf16 as it is, and InfoNCE's operands", BF16 | DOTS),
    ("bf16 as it is, and all results as they are stored", BF16 | DOTS | {f"{place} results" for place in [*PLACES, "info_nce"]}),
    ("bf16 as it is, but the torso f32", {c for c in BF16 if not c.startswith("torso")}),
    ("bf16 as it is, but gradients f32", {c for c in BF16 if not c.endswith("gradients")}),
]


# --- What is measured ----------------------------------------------------------------------------------------------------


def gradients(expect):
    return {name: g for name, g in expect.items() if ".grad." in name}


def error(got, reference):
    """Relative error and 1 - cosine of all gradients together, the largest 1 - cosine of a tensor, and of the loss the error."""
    got_g, reference_g = gradients(got), gradients(reference)
    flat = lambda named: torch.cat([g.flatten() for g in named.values()])
    a, b = flat(got_g), flat(reference_g)
    one_less = lambda a, b: (1 - a @ b / (a.norm() * b.norm())).item()
    large = [name for name, g in reference_g.items() if g.norm() >= SHARE_MIN * b.norm()]
    tensors = max(one_less(got_g[name].flatten(), reference_g[name].flatten()) for name in large)
    loss = (got["expect.loss.total"] - reference["expect.loss.total"]).abs().item()
    return [((a - b).norm() / b.norm()).item(), one_less(a, b), tensors, loss]


def in_f32(case, config):
    """The same update with every number f32."""
    double, cases.torch.Tensor.double = torch.Tensor.double, torch.Tensor.float
    kept = torch.float64
    try:
        torch.float64 = torch.float32
        return {name: value.to(kept) for name, value in cases.update(case, config).items()}
    finally:
        torch.Tensor.double, torch.float64 = double, kept


def learned(case, config, steps):
    """The case after `steps` updates on its own batch, Adam's with moments."""
    online = {n: t.clone().requires_grad_() for n, t in case.items() if n.startswith("online.")}
    adam = torch.optim.Adam(online.values(), lr=config["adam"]["lr"], eps=config["adam"]["eps"])
    for _ in range(steps):
        expect = in_f32(case | {n: t.detach() for n, t in online.items()}, config)
        for name, p in online.items():
            p.grad = expect[f"expect.grad.{name[7:]}"].float()
        torch.nn.utils.clip_grad_norm_(online.values(), config["max_grad_norm"])
        adam.step()
    return case | {n: t.detach() for n, t in online.items()}


def full_size(rows):
    """C51 with global DIM at the paper's sizes, on made-up frames of 64 x 64."""
    return cases.make(
        seed=21, rows=rows, height=64, width=64, objective="dim", lambdas=[0.0, 0.0, 0.0, 1.0], action=True,
        scale=1.0, actions=15,
        model={"conv": [[32, 8, 4], [64, 4, 2], [64, 3, 1]], "hidden": 512, "rkhs": 512, "action_embed": 64},
    )  # fmt: skip


def master_weights(case, config):
    """Of a step of Adam on weights that are kept in bf16: the share that is lost, and of the parameters that do not move."""
    expect = cases.update(case, config)
    lost = moved = still = count = 0
    for name, value in expect.items():
        if ".updated." in name:
            before = rounded(case["online." + name[len("expect.updated.") :]].double())
            step = value - case["online." + name[len("expect.updated.") :]].double()
            got = rounded(before + step) - before
            lost, moved = lost + ((got - step) ** 2).sum().item(), moved + (step**2).sum().item()
            still, count = still + (got == 0).sum().item(), count + got.numel()
    return (lost / moved) ** 0.5, still / count


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--rows", type=int, default=64, help="rows of the full-size batch")
    arguments.add_argument("--steps", type=int, default=10, help="updates after which it is measured again")
    args = arguments.parse_args()
    batches = []
    for name in FILES:
        with safe_open(cases.HERE / f"{name}.safetensors", "pt") as file:
            case = {key: file.get_tensor(key) for key in file.keys()}
            batches.append((case, json.loads(file.metadata()["config"])))
    case, config = full_size(args.rows)
    after = learned(case, config, args.steps)
    groups = [batches, [(case, config)], [(after, config)]]
    references = [[cases.update(*batch) for batch in group] for group in groups]
    for name, reference in zip(["at the start", "after"], references[1:]):
        losses = {key[7:]: round(value.item(), 3) for key, value in reference[0].items() if ".loss." in key}
        print(f"full size, {args.rows} rows, {name}: {losses}")

    def row(name, update):
        cells = []
        for group, reference in zip(groups, references):
            errors = [error(update(*batch), expect) for batch, expect in zip(group, reference)]
            worst = [max(column) for column in zip(*errors)]
            cells += [f"{worst[0]:.1e}", f"{worst[2]:.1e}"]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)

    def of(chosen):
        def update(case, config):
            with rounding(chosen):
                return cases.update(case, config)

        return update

    print("| rounded to bf16 | open cases: error | 1 - cosine | full size: error | 1 - cosine | after updates: error | 1 - cosine |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    row("nothing; all f32", in_f32)
    for name, chosen in CHOICES:
        row(name, of(chosen))
    lost, still = zip(*(master_weights(*batch) for batch in [(case, config), (after, config)]))
    print(f"master weights in bf16: {lost[0]:.2f}, {lost[1]:.2f} of a step lost (2-norm); {still[0]:.2f}, {still[1]:.2f} of the parameters stay")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
