#!/usr/bin/env python3
"""Makes the parity cases of what came after the first five files: no_action, cpc*, curl*, dueling, noisy*,
one_action, weighted_rows.

Needs PyTorch and safetensors; nothing in the project needs either. Everything is float64 and automatic differentiation, and
written from the formulas in deploy/docs/src/reference/parity.md, not from the learner's code.

    python3 make_cases.py            writes the cases beside this file (the same bytes every time)
    python3 make_cases.py --check    recomputes every case beside this file, the first five too, and prints the differences
"""

import json
import math
import sys
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.torch import save_file

HERE = Path(__file__).resolve().parent
NOISES = ["online", "choice", "target"]
PAIRS = ["3t3", "3t4", "4t3", "4t4"]
ADAM = {"lr": 2.5e-4, "beta1": 0.9, "beta2": 0.999, "eps": 0.01 / 256}


# --- The network ---------------------------------------------------------------------------------------------------------


def block(p, name, x):
    """A residual block on the last dimension of x."""
    hidden = F.relu(F.linear(x, p[f"{name}.hidden.weight"], p[f"{name}.hidden.bias"]))
    out = F.linear(hidden, p[f"{name}.out.weight"], p[f"{name}.out.bias"])
    return out + F.linear(x, p[f"{name}.skip.weight"], p.get(f"{name}.skip.bias"))


def linear(p, name, x, noise):
    """A linear layer of the C51 head; of a noisy one the mean where no noise is given."""
    if f"{name}.weight" in p:
        return F.linear(x, p[f"{name}.weight"], p[f"{name}.bias"])
    weight, bias = p[f"{name}.weight_mu"], p[f"{name}.bias_mu"]
    if noise:
        inputs, outputs = (noise[f"{name}.{side}"].double() for side in ["in", "out"])
        inputs, outputs = (eps.sign() * eps.abs().sqrt() for eps in [inputs, outputs])
        weight = weight + p[f"{name}.weight_sigma"] * outputs[:, None] * inputs
        bias = bias + p[f"{name}.bias_sigma"] * outputs
    return F.linear(x, weight, bias)


def stage(p, name, x):
    """A stage of the torsos impala and impoola: convolution, max pool, two residual blocks."""

    def conv(part, x):
        return F.conv2d(x, p[f"{name}.{part}.weight"], p[f"{name}.{part}.bias"], padding=1)

    x = F.max_pool2d(conv("conv", x), 3, 2, padding=1)
    for block in ["block1", "block2"]:
        x = x + conv(f"{block}.conv2", F.relu(conv(f"{block}.conv1", F.relu(x))))
    return x


def features(p, config, frames):
    """f3 [B, locations, channels] and f4 [B, hidden] of bytes [B, H, W, C]."""
    x = frames.double().permute(0, 3, 1, 2) / 255
    for i, (_, _, stride) in enumerate(config["model"].get("conv", []), 1):
        x = F.relu(F.conv2d(x, p[f"torso.conv{i}.weight"], p[f"torso.conv{i}.bias"], stride=stride))
    for i, _ in enumerate(config["model"].get("channels", []), 1):
        x = stage(p, f"torso.stage{i}", x)
    x = F.relu(x)
    flat = x.mean((2, 3)) if config["model"].get("torso") == "impoola" else x.flatten(1)
    f4 = F.linear(flat, p["torso.fc.weight"], p["torso.fc.bias"])
    return x.flatten(2).transpose(1, 2), f4


def distribution(p, config, f4, noise=None):
    """Logarithms of the return distributions [B, actions, atoms], with the noise of noisy layers if it is given."""
    sizes = (len(f4), config["actions"], config["atoms"])
    if not config.get("head", {}).get("dueling"):
        return F.log_softmax(linear(p, "head", F.relu(f4), noise).view(sizes), 2)
    advantage = linear(p, "head.advantage", F.relu(f4), noise).view(sizes)
    value = linear(p, "head.value", F.relu(f4), noise)[:, None]
    return F.log_softmax(value + advantage - advantage.mean(1, keepdim=True), 2)


def embedded(p, config, action):
    """The action's embedding [B, e], or nothing where Psi is not given the action."""
    if not config.get("condition_on_action", True):
        return None
    return block(p, "dim.action", F.one_hot(action, config["actions"]).double())


def psi(p, name, x, action):
    """Psi of features [B, .., f], joined with the embedding at every location."""
    if action is not None:
        shape = x.shape[:-1] + action.shape[-1:]
        x = torch.cat([x, action.view(len(x), *[1] * (x.dim() - 2), -1).expand(shape)], -1)
    return block(p, f"dim.{name}", x)


# --- The losses ----------------------------------------------------------------------------------------------------------


def clipped(dots, config):
    c = config["tanh_clip"]
    return c * torch.tanh(dots / math.sqrt(config["model"]["rkhs"]) / c)


def info_nce(dots, config):
    """Mean of -log softmax over the candidates at the diagonal; dots [locations, B, B]."""
    scores = F.log_softmax(clipped(dots, config), 2)
    return -torch.diagonal(scores, dim1=1, dim2=2).mean()


def pair_losses(p, config, t, k, action):
    """The InfoNCE losses of all four pairs, for rows that all have a positive."""
    vectors_t = {"3": psi(p, "psi3", t[0], action), "4": psi(p, "psi4", t[1], action)}
    vectors_k = {"3": block(p, "dim.phi3", k[0]), "4": block(p, "dim.phi4", k[1])}
    losses = {}
    for pair in PAIRS:
        a, b = vectors_t[pair[0]], vectors_k[pair[2]]
        # A global vector stands at every location of a local one.
        a = a if pair[0] == "3" else a[:, None].expand(-1, b.shape[1] if pair[2] == "3" else 1, -1)
        b = b if pair[2] == "3" else b[:, None].expand(-1, a.shape[1], -1)
        losses[pair] = info_nce(torch.einsum("ilr,jlr->lij", a, b), config)
    return losses


def masked_losses(p, config, t, k, action, valid):
    """pair_losses of the rows that are valid; 0 if fewer than two are."""
    rows = valid.nonzero().flatten()
    if len(rows) < 2:
        return {pair: torch.zeros((), dtype=torch.float64) for pair in PAIRS}
    chosen = None if action is None else action[rows]
    return pair_losses(p, config, [f[rows] for f in t], [f[rows] for f in k], chosen)


def auxiliary_losses(online, key, config, case):
    """The losses of every pair that the objective knows, before their weights."""
    objective = config.get("objective", "dim")
    action = None if objective == "curl" else embedded(online, config, case["input.action"])
    if objective == "curl":
        query = psi(online, "psi4", features(online, config, case["input.view_query"])[1], None)
        with torch.no_grad():
            keys = psi(key, "psi4", features(key, config, case["input.view_key"])[1], None)
        return {"4t4": info_nce((query @ keys.T)[None], config)}
    t = features(online, config, case["input.frames_t"])
    later, valid = case["input.frames_k"], case["input.positive_valid"]
    if objective != "cpc":
        later, valid = later[None], valid[None]
    offsets = [
        masked_losses(online, config, t, features(online, config, frames), action, here)
        for frames, here in zip(later, valid)
    ]
    return {pair: sum(losses[pair] for losses in offsets) / len(offsets) for pair in PAIRS}


def projection(config, probs, reward, discount):
    """The distribution moved one Bellman step and back onto the atoms [B, atoms]."""
    low, high, count = config["v_min"], config["v_max"], config["atoms"]
    atoms = torch.linspace(low, high, count, dtype=torch.float64)
    moved = (reward[:, None] + discount[:, None] * atoms).clamp(low, high)
    share = (1 - (moved[:, None, :] - atoms[None, :, None]).abs() * (count - 1) / (high - low)).clamp(min=0)
    return (share * probs[:, None, :]).sum(2)


# --- One update ----------------------------------------------------------------------------------------------------------


def update(case, config):
    """Everything that is expected of the update of a case, by name."""
    online = {n[7:]: t.double().requires_grad_() for n, t in case.items() if n.startswith("online.")}
    target = {n[7:]: t.double() for n, t in case.items() if n.startswith("target.")}
    key = {n[4:]: t.double() for n, t in case.items() if n.startswith("key.")}
    noise = {
        who: {n.removeprefix(f"noise.{who}."): t for n, t in case.items() if n.startswith(f"noise.{who}.")}
        for who in NOISES
    }
    rows = torch.arange(len(case["input.action"]))
    atoms = torch.linspace(config["v_min"], config["v_max"], config["atoms"], dtype=torch.float64)
    expect = {}
    with torch.no_grad():
        after = distribution(target, config, features(target, config, case["input.frames_n"])[1], noise["target"]).exp()
        chooser, eps = (online, noise["choice"]) if config["double_dqn"] else (target, noise["target"])
        choice = distribution(chooser, config, features(chooser, config, case["input.frames_n"])[1], eps).exp()
        greedy = (choice @ atoms).argmax(1)
        goal = projection(
            config, after[rows, greedy], case["input.n_step_return"].double(), case["input.bootstrap_discount"].double()
        )
        f4 = features(online, config, case["input.frames_t"])[1]
        # Values are those that are acted on in evaluation: without noise.
        expect["q_values_t"] = distribution(online, config, f4).exp() @ atoms
    log_probs = distribution(online, config, features(online, config, case["input.frames_t"])[1], noise["online"])
    row_kl = (torch.xlogy(goal, goal) - goal * log_probs[rows, case["input.action"]]).sum(1)
    weight = case.get("input.importance_weight")
    kl = row_kl.mean() if weight is None else (weight.double() * row_kl).mean()
    losses = auxiliary_losses(online, key, config, case)
    total = kl + sum(config["lambda"][pair] * loss for pair, loss in losses.items() if config["lambda"][pair] > 0)

    expect["next_action"] = greedy
    expect["target_projection"] = goal
    if weight is not None:
        expect["row_kl"] = row_kl.detach()
    expect["loss.c51_kl"] = kl.detach().view(1)
    expect["loss.total"] = total.detach().view(1)
    for pair, loss in losses.items():
        expect[f"loss.dim.{pair}"] = loss.detach().view(1)
    gradients = torch.autograd.grad(total, list(online.values()), allow_unused=True)
    gradients = [torch.zeros_like(p) if g is None else g for p, g in zip(online.values(), gradients)]
    norm = torch.sqrt(sum((g**2).sum() for g in gradients))
    expect["grad_norm"] = norm.view(1)
    factor = min(1.0, config["max_grad_norm"] / (norm.item() + 1e-6))
    adam = config["adam"]
    for (name, p), g in zip(online.items(), gradients):
        expect[f"grad.{name}"] = g
        # The first step, with its corrections of the bias: m = g, v = g^2.
        g = g * factor
        expect[f"updated.{name}"] = p.detach() - adam["lr"] * g / (g.abs() + adam["eps"])
    for name, slow in key.items():
        tau = config["key_tau"]
        expect[f"updated_key.{name}"] = tau * expect[f"updated.{name}"] + (1 - tau) * slow
    return {f"expect.{name}": value for name, value in expect.items()}


# --- The cases -----------------------------------------------------------------------------------------------------------


def head_layers(config):
    """Outputs of the C51 head's layers."""
    outputs = config["actions"] * config["atoms"]
    if config.get("head", {}).get("dueling"):
        return {"head.value": config["atoms"], "head.advantage": outputs}
    return {"head": outputs}


def shapes(config, heads, action):
    """PyTorch's shapes of all parameters."""
    model, named = config["model"], {}

    def layer(name, weight, bias=True):
        named[f"{name}.weight"] = weight
        if bias:
            named[f"{name}.bias"] = weight[:1]

    def residual(name, width, out, skip_bias=False):
        layer(f"{name}.hidden", [out, width])
        layer(f"{name}.out", [out, out])
        layer(f"{name}.skip", [out, width], skip_bias)

    height, width, channels = (config["obs"][side] for side in ["height", "width", "channels"])
    for i, (out, kernel, stride) in enumerate(model["conv"], 1):
        layer(f"torso.conv{i}", [out, channels, kernel, kernel])
        height, width, channels = (height - kernel) // stride + 1, (width - kernel) // stride + 1, out
    layer("torso.fc", [model["hidden"], height * width * channels])
    for name, outputs in head_layers(config).items():
        if "noisy_sigma" in config.get("head", {}):
            for end in ["mu", "sigma"]:
                named[f"{name}.weight_{end}"] = [outputs, model["hidden"]]
                named[f"{name}.bias_{end}"] = [outputs]
        else:
            layer(name, [outputs, model["hidden"]])
    if action:
        residual("dim.action", config["actions"], model["action_embed"], True)
    for head in heads:
        width = channels if head[-1] == "3" else model["hidden"]
        joined = model["action_embed"] if action and head.startswith("psi") else 0
        residual(f"dim.{head}", width + joined, model["rkhs"])
    return named


def parameters(config, heads, action, generator, scale):
    """Random parameters in which nothing is 0 and scores spread."""
    made = {}
    for name, shape in shapes(config, heads, action).items():
        inputs = math.prod(shape[1:]) if len(shape) > 1 else 25
        gain = scale if name.startswith("dim.") else 0.25 if name.endswith("_sigma") else 0.5 if name.endswith("_mu") else 1.5
        made[name] = (torch.randn(shape, generator=generator) * gain / math.sqrt(inputs)).float()
    return made


def make(seed, rows, height, width, objective, lambdas, positives=1, action=False, heads=None, scale=1.5, beta=None, **settings):
    """One case: inputs, parameters, and what the update of them gives."""
    g = torch.Generator().manual_seed(seed)
    config = {
        "obs": {"height": height, "width": width, "channels": 3},
        "actions": 4, "atoms": 51, "v_min": -10.0, "v_max": 10.0, "gamma": 0.99, "n_step": 7,
        "double_dqn": False,
        "objective": objective, "condition_on_action": action,
        "lambda": dict(zip(PAIRS, lambdas)),
        "tanh_clip": 20.0, "max_grad_norm": 10.0, "adam": ADAM,
        "model": {"conv": [[4, 8, 4], [5, 4, 2], [6, 3, 1]], "hidden": 16, "rkhs": 12, "action_embed": 6},
    } | settings  # fmt: skip
    heads = heads or ["psi3", "phi3", "psi4", "phi4"]

    def frames(*leading):
        # Blocks, so that frames differ in more than noise.
        coarse = torch.randint(0, 256, (math.prod(leading), 3, 5, 5), generator=g).float()
        fine = F.interpolate(coarse, (height, width), mode="nearest") + 30 * torch.randn(
            (1, 3, height, width), generator=g
        )
        return fine.clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1).reshape(*leading, height, width, 3).contiguous()

    online = parameters(config, heads, action, g, scale)
    def older(names):
        """An older online network."""
        named = {n: t for n, t in online.items() if n.startswith(names)}
        return {n: (t + 0.1 * t.abs().mean() * torch.randn(t.shape, generator=g)).float() for n, t in named.items()}

    case = {f"online.{n}": t for n, t in online.items()}
    case |= {f"target.{n}": t for n, t in older(("torso.", "head.")).items()}
    if objective == "curl":
        case |= {f"key.{n}": t for n, t in older(("torso.", "dim.psi4.")).items()}
    case["input.frames_t"], case["input.frames_n"] = frames(rows), frames(rows)
    case["input.action"] = torch.randint(0, config["actions"], (rows,), generator=g)
    case["input.n_step_return"] = (4 * torch.randn(rows, generator=g)).float()
    case["input.bootstrap_discount"] = torch.full((rows,), 0.99**7).float()
    case["input.bootstrap_discount"][0] = 0
    if objective == "curl":
        t = case["input.frames_t"]
        case["input.view_query"] = (t.roll(2, 1) * 0.7 + 20).to(torch.uint8)
        case["input.view_key"] = (255 - t.roll(-3, 2) * 0.9).to(torch.uint8)
    elif objective == "cpc":
        case["input.frames_k"] = frames(positives, rows)
        # Row 0 has no successor; the others' episodes end after so many steps that offsets differ, and the last has one row.
        steps = torch.tensor([0, positives] + [1 + i % (positives - 1) for i in range(rows - 2)])
        if positives == 3:
            steps = torch.full((rows,), 3)
        case["input.positive_valid"] = (torch.arange(positives)[:, None] < steps[None]).to(torch.uint8)
    else:
        case["input.frames_k"] = frames(rows)
        case["input.positive_valid"] = torch.ones(rows, dtype=torch.uint8)
        case["input.positive_valid"][0] = 0
    if "noisy_sigma" in config.get("head", {}):
        for who in NOISES:
            for name, outputs in head_layers(config).items():
                case[f"noise.{who}.{name}.in"] = torch.randn(config["model"]["hidden"], generator=g)
                case[f"noise.{who}.{name}.out"] = torch.randn(outputs, generator=g)
    if beta is not None:
        # As of rows drawn by priority: (N P)^-beta over the batch's largest.
        chance = torch.rand(rows, generator=g).double() ** 4 + 1e-4
        case["input.importance_weight"] = ((chance.min() / chance) ** beta).float()
    return case, config


CASES = {
    "no_action": dict(seed=11, rows=6, height=36, width=44, objective="dim", lambdas=[1.0, 0.0, 0.0, 1.0]),
    "cpc": dict(
        seed=12, rows=7, height=36, width=44, objective="cpc", lambdas=[0.0, 0.0, 0.0, 1.0], positives=5,
    ),
    "cpc_all_pairs": dict(
        seed=13, rows=5, height=40, width=36, objective="cpc", lambdas=[0.5, 1.0, 0.25, 2.0], positives=3,
        action=True, max_grad_norm=0.5,
    ),
    "curl": dict(
        seed=14, rows=7, height=36, width=44, objective="curl", lambdas=[0.0, 0.0, 0.0, 1.0], heads=["psi4"],
        key_tau=0.001,
    ),
    "curl_clipped": dict(
        seed=15, rows=9, height=44, width=36, objective="curl", lambdas=[0.0, 0.0, 0.0, 0.5], heads=["psi4"],
        double_dqn=True, max_grad_norm=0.25, tanh_clip=5.0, key_tau=0.3,
    ),
    "dueling": dict(
        seed=16, rows=8, height=36, width=44, objective="dim", lambdas=[0.5, 0.0, 0.0, 1.0], action=True,
        double_dqn=True, head={"dueling": True},
    ),
    "noisy": dict(
        seed=17, rows=7, height=44, width=36, objective="dim", lambdas=[0.0, 0.0, 0.0, 1.0], double_dqn=True,
        head={"noisy_sigma": 0.5}, max_grad_norm=0.5,
    ),
    "noisy_dueling": dict(
        seed=20, rows=8, height=36, width=44, objective="none", lambdas=[0.0, 0.0, 0.0, 0.0], double_dqn=True,
        head={"dueling": True, "noisy_sigma": 0.5},
    ),
    # A single action has an embedding too.
    "one_action": dict(
        seed=21, rows=3, height=36, width=36, objective="dim", lambdas=[1.0, 0.5, 0.5, 1.0], action=True,
        double_dqn=True, actions=1,
    ),
    "weighted_rows": dict(
        seed=16, rows=8, height=36, width=44, objective="dim", lambdas=[0.0, 0.0, 0.0, 1.0], action=True, beta=0.4,
    ),
}  # fmt: skip


def check():
    worst = 0.0
    for path in sorted(HERE.glob("*.safetensors")):
        with safe_open(path, "pt") as file:
            config = json.loads(file.metadata()["config"])
            case = {name: file.get_tensor(name) for name in file.keys()}
        expected = {name: value for name, value in case.items() if name.startswith("expect.")}
        got = update(case, config)
        assert got.keys() == expected.keys(), (path.name, got.keys() ^ expected.keys())
        difference = max(
            ((got[name].double() - value.double()).abs().max() / (1 + value.double().abs().max())).item()
            for name, value in expected.items()
        )
        print(f"{path.name:32} largest relative difference {difference:.1e}")
        worst = max(worst, difference)
    sys.exit(worst > 1e-9)


def write():
    for name, arguments in CASES.items():
        case, config = make(**arguments)
        expect = update(case, config)
        tensors = {key: value.contiguous() for key, value in (case | expect).items()}
        save_file(tensors, HERE / f"{name}.safetensors", {"config": json.dumps(config)})
        losses = {key[12:]: round(value.item(), 4) for key, value in expect.items() if ".loss." in key}
        print(name, losses, "norm", round(expect["expect.grad_norm"].item(), 3))


if __name__ == "__main__":
    torch.set_num_threads(1)
    check() if "--check" in sys.argv[1:] else write()
