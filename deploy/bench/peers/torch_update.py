"""The learner's update in PyTorch, eager: C51 with or without DIM, gradients clipped by their norm, Adam.

It is the same work as `driml bench learner`: the same network, sizes, losses and optimiser, on made-up batches of bytes.
`--check CASE.safetensors` shows it: losses, gradients and updated parameters against a float64 reference of tests/parity.
PyTorch's fused Adam is taken, and of its two memory formats the faster one. On the CPU the same is measured under bf16 autocast;
what stands beside our bf16 is the faster of that and f32. With `--device cuda` an update starts with bytes in
the host's memory and ends when its losses are back there; `--compile` has torch.compile fuse its forward pass.
"""

import json
import sys

import torch
from torch.nn import functional

import measure
from driml_net import Network

# As the presets `paper` and `paper-observation` have it for Procgen.
CONFIG = {
    "obs": {"height": 64, "width": 64, "channels": 3},
    "actions": 15,
    "atoms": 51,
    "v_min": -10.0,
    "v_max": 10.0,
    "double_dqn": False,
    "lambda": {"3t3": 0.0, "3t4": 0.0, "4t3": 0.0, "4t4": 0.0},
    "tanh_clip": 20.0,
    "max_grad_norm": 10.0,
    "adam": {"lr": 2.5e-4, "beta1": 0.9, "beta2": 0.999, "eps": 0.01 / 256},
    "model": {"hidden": 512, "rkhs": 512, "action_embed": 64},
}
NATURE = {"torso": "nature", "conv": [[32, 8, 4], [64, 4, 2], [64, 3, 1]]}
IMPALA = {"torso": "impala", "channels": [16, 32, 32]}
NARROW = {"torso": "impala", "channels": [8, 16, 16]}
# Rows, height and width, DIM pairs, torso.
CASES = {
    "C51, 64x64x3": (256, (64, 64), [], NATURE),
    "C51 + global-global DIM, 64x64x3": (256, (64, 64), ["4t4"], NATURE),
    "C51 + local-local + global-global DIM, 64x64x3": (256, (64, 64), ["3t3", "4t4"], NATURE),
    "C51 + global-global DIM, 104x80x3": (256, (104, 80), ["4t4"], NATURE),
    "C51, impala, 64x64x3": (256, (64, 64), [], IMPALA),
    "C51, impala, 64x64x3, 64 rows": (64, (64, 64), [], IMPALA),
    "C51, impala, half width, 64x64x3": (256, (64, 64), [], NARROW),
    "C51 + global-global DIM, impala, 64x64x3": (256, (64, 64), ["4t4"], IMPALA),
}
GAMMA, N_STEP = 0.99, 7
FORMATS = {"contiguous": torch.contiguous_format, "channels-last": torch.channels_last}


def of(config, pairs=frozenset()):
    """The network of a parity case's configuration, with the heads of these DIM pairs, such as {"4t4"}."""
    obs, model = config["obs"], config["model"]
    table = dict(model, embedding_dim=model["rkhs"], num_actions=config["actions"], height=obs["height"], width=obs["width"], input_channels=obs["channels"])
    table |= {name: config[name] for name in ("atoms", "v_min", "v_max")}
    table["conv"] = [dict(zip(("out", "kernel", "stride"), layer)) for layer in model.get("conv", [])]
    table["head"] = config.get("head", {})
    table["dim"] = {"action": config.get("condition_on_action", True)}
    for level in "34":
        table["dim"]["psi" + level] = any(pair[0] == level for pair in pairs)
        table["dim"]["phi" + level] = any(pair[2] == level for pair in pairs)
    return Network(table)


def project(probs, reward, discount, v_min, v_max):
    """Return distributions [B, N] one Bellman step earlier, back on the atoms. Bellemare et al. 2017, algorithm 1."""
    rows, atoms = probs.shape
    support = torch.linspace(v_min, v_max, atoms, device=probs.device)
    moved = (reward[:, None] + discount[:, None] * support).clamp(v_min, v_max)
    position = ((moved - v_min) * ((atoms - 1) / (v_max - v_min))).clamp(0, atoms - 1)
    low = position.floor()
    above = position - low
    low = low.long()
    out = torch.zeros(rows, atoms, device=probs.device)
    out.scatter_add_(1, low, probs * (1 - above))
    return out.scatter_add_(1, (low + 1).clamp(max=atoms - 1), probs * above)


def info_nce(psi, phi, clip):
    """Psi [B, R] or [B, L, R], Phi alike: mean over locations and anchors of -ln softmax of the positive's score."""
    rkhs = psi.shape[-1]
    if psi.dim() == 3 and phi.dim() == 3:
        dots = psi.transpose(0, 1) @ phi.permute(1, 2, 0)
    elif psi.dim() == 3:
        dots = (psi @ phi.t()).transpose(0, 1)
    elif phi.dim() == 3:
        dots = psi @ phi.permute(1, 2, 0)
    else:
        dots = (psi @ phi.t()).unsqueeze(0)
    scores = clip * torch.tanh(dots * (1 / (rkhs**0.5 * clip)))
    return -scores.log_softmax(-1).diagonal(dim1=1, dim2=2).mean()


class Learner:
    def __init__(self, config, memory_format, device, online=None, target=None, compiled=False, bf16=False):
        self.config, self.memory_format, self.device, self.bf16 = config, memory_format, device, bf16
        self.weights = {pair: weight for pair, weight in config["lambda"].items() if weight > 0}
        self.online, self.target = of(config, set(self.weights)), of(config)
        if online is None:
            target = {name: value for name, value in self.online.state_dict().items() if not name.startswith("dim.")}
        else:
            self.online.load_state_dict(online)
        self.target.load_state_dict(target)
        self.online.to(device=device, memory_format=memory_format)
        self.target.to(device=device, memory_format=memory_format).requires_grad_(False)
        adam = config["adam"]
        betas = (adam["beta1"], adam["beta2"])
        self.adam = torch.optim.Adam(self.online.parameters(), adam["lr"], betas, adam["eps"], fused=True)
        if compiled:
            # Each learner has one shape; without this the second one of a process is compiled for all shapes.
            torch.compiler.reset()
            self.losses = torch.compile(self.losses, dynamic=False)

    def on_device(self, batch):
        """The batch where the network is; on the CPU nothing is copied."""
        return {name: value.to(self.device, non_blocking=True) for name, value in batch.items()}

    def images(self, frames):
        """Bytes [B, H, W, C] as PyTorch's [B, C, H, W]."""
        return frames.permute(0, 3, 1, 2).contiguous(memory_format=self.memory_format)

    @torch.no_grad()
    def projected(self, batch):
        frames_n = self.images(batch["frames_n"])
        logits = self.target.logits_of(self.target.features_of_images(frames_n)[1])
        if self.config["double_dqn"]:
            online = self.online.logits_of(self.online.features_of_images(frames_n)[1])
            values = self.online.expected_returns(online)
        else:
            values = self.target.expected_returns(logits)
        probs = logits[torch.arange(len(logits), device=logits.device), values.argmax(1)].softmax(-1)
        discount, support = batch["bootstrap_discount"], (self.config["v_min"], self.config["v_max"])
        return project(probs, batch["n_step_return"], discount, *support)

    def losses(self, batch, all_valid):
        """The C51 loss, the DIM losses by pair, and their weighted sum; `all_valid`: whether every row has a positive."""
        target, action = self.projected(batch), batch["action"]
        features_t = self.online.features_of_images(self.images(batch["frames_t"]))
        logits = self.online.logits_of(features_t[1])[torch.arange(len(action), device=action.device), action]
        kl = functional.kl_div(logits.log_softmax(-1), target, reduction="batchmean")
        dim, vectors = {}, {}
        if self.weights:
            features_k = self.online.features_of_images(self.images(batch["frames_k"]))
            valid = batch["positive_valid"].bool()
            for pair in self.weights:
                for head, features, given in (("psi" + pair[0], features_t, action), ("phi" + pair[2], features_k, None)):
                    if head not in vectors:
                        found = self.online.vectors(head, features, given)
                        vectors[head] = found if all_valid else found[valid]
                dim[pair] = info_nce(vectors["psi" + pair[0]], vectors["phi" + pair[2]], self.config["tanh_clip"])
        return kl, dim, kl + sum(self.weights[pair] * loss for pair, loss in dim.items())

    def update(self, batch):
        """One update: losses and the gradients' norm before clipping."""
        self.adam.zero_grad(set_to_none=True)
        # Read on the host: on the device it would be waited for, and would cut the compiled graph in two.
        all_valid = bool(batch["positive_valid"].all())
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16):
            kl, dim, total = self.losses(self.on_device(batch), all_valid)
        total.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.online.parameters(), self.config["max_grad_norm"])
        self.adam.step()
        return kl.item(), {pair: loss.item() for pair, loss in dim.items()}, total.item(), norm.item()


def synthetic(config, rows, device):
    """A batch that no world gave, in the host's memory; pinned if it will be copied to a device."""
    obs = config["obs"]
    shape = (rows, obs["height"], obs["width"], obs["channels"])
    batch = {f"frames_{which}": torch.randint(0, 256, shape, dtype=torch.uint8) for which in "tkn"}
    batch["action"] = torch.randint(0, config["actions"], (rows,))
    batch["n_step_return"] = torch.rand(rows) * 4 - 2
    batch["bootstrap_discount"] = torch.full((rows,), GAMMA**N_STEP)
    batch["positive_valid"] = torch.ones(rows, dtype=torch.uint8)
    return batch if device.type == "cpu" else {name: value.pin_memory() for name, value in batch.items()}


def timed(learner, batch):
    """An update of which nothing is still under way on the device when it returns."""
    learner.update(batch)
    if learner.device.type == "cuda":
        torch.cuda.synchronize(learner.device)


def bench(effort, device, compiled):
    figures, formats = {}, []
    for what, (rows, (height, width), pairs, torso) in CASES.items():
        config = dict(CONFIG, obs={"height": height, "width": width, "channels": 3}, model=CONFIG["model"] | torso)
        config["lambda"] = {pair: float(pair in pairs) for pair in CONFIG["lambda"]}
        batch, rates = synthetic(config, rows, device), {}
        for bf16 in (False, True) if device.type == "cpu" else (False,):
            for name, memory_format in FORMATS.items():
                learner = Learner(config, memory_format, device, compiled=compiled, bf16=bf16)
                name += ", bf16 autocast" if bf16 else ""
                # It compiles during the warm-up.
                rates[name] = effort.rate_by_median(lambda: timed(learner, batch))
                print(f"  {what}, {name}: {rates[name]:.4g} updates/s", file=sys.stderr, flush=True)
            best = max(rates, key=rates.get)
            figures[what + (", bf16" if bf16 else "")] = rates[best]
            formats.append(best)
    peer = [f"PyTorch {torch.__version__}", " or ".join(sorted(set(formats)))]
    if device.type == "cuda":
        peer.append(torch.cuda.get_device_name(device))
    if compiled:
        peer.append("compiled")
    measure.report(", ".join(peer), figures)


def check(path, device):
    """Whether one update of a parity case comes out as float64 has it; prints the largest errors."""
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        config = json.loads(file.metadata()["config"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}

    def group(prefix):
        return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}

    expect, good = group("expect."), True

    def line(what, error, tolerance):
        nonlocal good
        good &= error <= tolerance
        print(f"  {what:<24} error {error:9.2e}  tolerance {tolerance:9.2e}  {'ok' if error <= tolerance else 'FAILED'}")

    print(path)
    parameters = group("online.")
    others = config.get("objective", "dim") not in ("dim", "none") or "noisy_sigma" in config.get("head", {})
    if others or "input.importance_weight" in tensors:
        print("  skipped: another agent's loss, noisy layers or weighted rows, which this script does not have")
        return True
    names = of(config, {pair for pair, weight in config["lambda"].items() if weight > 0}).state_dict().keys()
    for name, memory_format in FORMATS.items():
        online, target = {key: parameters[key] for key in names}, group("target.")
        learner = Learner(config, memory_format, device, online, target)
        projected = learner.projected(learner.on_device(group("input."))).cpu()
        line(f"projection, {name}", (projected - expect["target_projection"]).abs().max().item(), 5e-6)
        kl, dim, total, norm = learner.update(group("input."))
        for what, value in {"c51_kl": kl, "total": total, **{f"dim.{pair}": loss for pair, loss in dim.items()}}.items():
            expected = expect[f"loss.{what}"].item()
            line(f"{what}, {name}", abs(value - expected), max(1e-4 * abs(expected), 1e-6))
        expected = expect["grad_norm"].item()
        line(f"grad_norm, {name}", abs(norm - expected), 1e-4 * expected)
        updated = learner.online.state_dict().items()
        line(f"updated, {name}", max((value.cpu() - expect[f"updated.{key}"]).abs().max().item() for key, value in updated), 4e-6)
    return good


def main():
    arguments = measure.parser(__doc__)
    arguments.add_argument("--check", nargs="+", metavar="CASE", help="parity cases to check instead of measuring")
    arguments.add_argument("--device", type=torch.device, default="cpu", help="cpu, cuda or cuda:N [default: cpu]")
    arguments.add_argument("--compile", action="store_true", help="fuse the forward pass with torch.compile")
    args = arguments.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(1)
    if args.device.type == "cuda":
        # Convolutions in float32, as matrix products are by default and as ours are; the fastest algorithm for these sizes.
        torch.backends.cudnn.allow_tf32 = False
        torch.backends.cudnn.benchmark = True
    if args.check:
        sys.exit(0 if all([check(path, args.device) for path in args.check]) else 1)
    bench(measure.Effort(args.quick), args.device, args.compile)


if __name__ == "__main__":
    main()
