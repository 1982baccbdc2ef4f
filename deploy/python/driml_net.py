"""A run's network in PyTorch: loads the newest checkpoint of a run folder, and exports what acts as ONNX.

    python driml_net.py RUN                    # what the network is, and its values for a blank state
    python driml_net.py RUN --onnx net.onnx    # the network: states in, expected returns out
    python driml_net.py FILE.safetensors       # the same of what `driml evaluate --export` wrote

    from driml_net import load
    network, run = load("runs/coin")
    q = network(states)                        # states u8 [B, H, W, C] as deploy/docs/src/reference/weights.md says; q [B, A]

PyTorch is needed, and `onnx` and `onnxscript` for --onnx. Everything it must know is in the checkpoint's own metadata or, for
checkpoints of earlier versions, in the run's config.toml. Conventions: deploy/docs/src/reference/weights.md.
"""

import argparse
import json
import struct
import sys
from pathlib import Path

try:
    import torch
except ModuleNotFoundError:
    sys.exit(f"driml_net.py needs the package torch: {sys.executable} -m pip install torch")
from torch import nn
from torch.nn import functional

DTYPES = {"F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16}


def read_safetensors(path):
    """Tensors by name, as f32, and the metadata of a safetensors file; the format is 8 bytes of length, JSON, and bytes."""
    data = Path(path).read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    metadata = header.pop("__metadata__", {})
    tensors = {}
    for name, entry in header.items():
        start, end = (8 + length + offset for offset in entry["data_offsets"])
        raw = torch.frombuffer(bytearray(data[start:end]), dtype=DTYPES[entry["dtype"]])
        tensors[name] = raw.reshape(entry["shape"]).float()
    return tensors, metadata


def newest_checkpoint(run):
    """The folder of the newest checkpoint of a run."""
    found = sorted(path for path in Path(run, "checkpoints").glob("checkpoint-*") if path.name[11:].isdigit())
    if not found:
        raise SystemExit(f"{run} has no checkpoint")
    return found[-1]


def description(run, metadata):
    """The tables `model`, `input` and `run` of a run: from a checkpoint's metadata, else from config.toml."""
    if "driml" in metadata:
        described = json.loads(metadata["driml"])
        if described["format"] != 1:
            raise SystemExit(f"the checkpoint's metadata is of format {described['format']}, this file reads 1")
        return described
    import tomllib

    return tomllib.loads(Path(run, "config.toml").read_text())


class Block(nn.Module):
    """A DIM head: out(relu(hidden(x))) + skip(x)."""

    def __init__(self, inputs, outputs, skip_bias=False):
        super().__init__()
        self.hidden = nn.Linear(inputs, outputs)
        self.out = nn.Linear(outputs, outputs)
        self.skip = nn.Linear(inputs, outputs, bias=skip_bias)

    def forward(self, x):
        return self.out(functional.relu(self.hidden(x))) + self.skip(x)


class NoisyLinear(nn.Module):
    """A noisy layer (Fortunato et al. 2018) as it evaluates: by its means. The sigmas are there to be looked at."""

    def __init__(self, inputs, outputs):
        super().__init__()
        for end in ("mu", "sigma"):
            self.register_parameter(f"weight_{end}", nn.Parameter(torch.zeros(outputs, inputs)))
            self.register_parameter(f"bias_{end}", nn.Parameter(torch.zeros(outputs)))

    def forward(self, x):
        return functional.linear(x, self.weight_mu, self.bias_mu)


class Residual(nn.Module):
    """x + conv2(relu(conv1(relu(x))))."""

    def __init__(self, width):
        super().__init__()
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x):
        return x + self.conv2(functional.relu(self.conv1(functional.relu(x))))


class Stage(nn.Module):
    """A stage of the torsos impala and impoola."""

    def __init__(self, inputs, width):
        super().__init__()
        self.conv = nn.Conv2d(inputs, width, 3, padding=1)
        self.block1, self.block2 = Residual(width), Residual(width)

    def forward(self, x):
        return self.block2(self.block1(functional.max_pool2d(self.conv(x), 3, 2, padding=1)))


class Network(nn.Module):
    """Torso, C51 head and the DIM heads of a `[model]` table; parameters have the names and shapes of the checkpoint's."""

    def __init__(self, model):
        super().__init__()
        self.actions, self.atoms = model["num_actions"], model["atoms"]
        support = torch.linspace(model["v_min"], model["v_max"], self.atoms)
        self.register_buffer("support", support, persistent=False)
        self.torso = nn.ModuleDict()
        height, width, channels = model["height"], model["width"], model["input_channels"]
        # f4 sees the mean of f3 over its locations.
        self.takes_mean = model.get("torso") == "impoola"
        for number, out in enumerate(model.get("channels", []), 1):
            self.torso[f"stage{number}"] = Stage(channels, out)
            height, width, channels = (height + 1) // 2, (width + 1) // 2, out
        for number, layer in enumerate(model.get("conv", []), 1):
            kernel, stride = layer["kernel"], layer["stride"]
            self.torso[f"conv{number}"] = nn.Conv2d(channels, layer["out"], kernel, stride)
            height, width, channels = (height - kernel) // stride + 1, (width - kernel) // stride + 1, layer["out"]
        self.torso["fc"] = nn.Linear(channels * (1 if self.takes_mean else height * width), model["hidden"])
        head = model.get("head", {})
        layer = NoisyLinear if "noisy_sigma" in head else nn.Linear
        self.dueling = head.get("dueling", False)
        outputs = self.actions * self.atoms
        if self.dueling:
            streams = {"value": self.atoms, "advantage": outputs}
            self.head = nn.ModuleDict({name: layer(model["hidden"], outputs) for name, outputs in streams.items()})
        else:
            self.head = layer(model["hidden"], outputs)
        self.dim = nn.ModuleDict()
        dim, embedding_dim = model["dim"], model["embedding_dim"]
        embed = model["action_embed"] if dim["action"] and (dim["psi3"] or dim["psi4"]) else 0
        if embed:
            self.dim["action"] = Block(self.actions, embed, skip_bias=True)
        for name, inputs in [
            ("psi3", channels + embed),
            ("phi3", channels),
            ("psi4", model["hidden"] + embed),
            ("phi4", model["hidden"]),
        ]:
            if dim[name]:
                self.dim[name] = Block(inputs, embedding_dim)
        for layer in model.get("loss_layers", []):
            self.dim[layer["name"]] = nn.Linear(layer["inputs"], layer["outputs"])

    def features(self, states):
        """f3 [B, c, h, w] after its ReLU and f4 [B, hidden] before it, of u8 states [B, H, W, C]."""
        return self.features_of_images(states.permute(0, 3, 1, 2))

    def features_of_images(self, images):
        """The same of u8 images [B, C, H, W] in any memory format."""
        maps = images.float().div_(255)
        for name, layer in self.torso.items():
            if name != "fc":
                maps = layer(maps) if isinstance(layer, Stage) else functional.relu(layer(maps))
        maps = functional.relu(maps)
        return maps, self.torso["fc"](maps.mean((2, 3)) if self.takes_mean else maps.flatten(1))

    def logits(self, states):
        """Logits [B, A, N] of the returns at the atoms."""
        return self.logits_of(self.features(states)[1])

    def logits_of(self, f4):
        """The same of f4 [B, hidden]."""
        x = functional.relu(f4)
        if not self.dueling:
            return self.head(x).view(-1, self.actions, self.atoms)
        advantage = self.head["advantage"](x).view(-1, self.actions, self.atoms)
        return self.head["value"](x).unsqueeze(1) + advantage - advantage.mean(1, keepdim=True)

    def forward(self, states):
        """Expected returns [B, A]; the agent takes the action of the largest."""
        return self.expected_returns(self.logits(states))

    def expected_returns(self, logits):
        """Means [B, A] of the distributions of logits [B, A, N]."""
        return (logits.softmax(-1) * self.support).sum(-1)

    def vectors(self, head, features, actions=None):
        """Psi (psi3, psi4, with actions [B] if it was trained with them) or Phi (phi3, phi4): [B, R] of f4, [B, L, R] of f3."""
        f3, f4 = features
        x = f4 if head.endswith("4") else f3.flatten(2).transpose(1, 2)
        if actions is not None and "action" in self.dim:
            embedded = self.dim["action"](functional.one_hot(actions.long(), self.actions).float())
            if x.dim() == 3:
                embedded = embedded.unsqueeze(1).expand(-1, x.shape[1], -1)
            x = torch.cat([x, embedded], -1)
        return self.dim[head](x)


def load(run, checkpoint=None, weights=None):
    """The network of a run's newest checkpoint (or of the one named), in evaluation mode, and the tables that describe it.

    `weights`: "average", which has no DIM heads, or "online" [default: "average" if the checkpoint has it, as `driml evaluate`].
    """
    if Path(run).is_file():
        file, weights = run, "exported"
    else:
        folder = Path(checkpoint) if checkpoint else newest_checkpoint(run)
        if weights is None:
            weights = "average" if (folder / "average.safetensors").exists() else "online"
        file = folder / f"{weights}.safetensors"
    if not Path(file).exists():
        raise SystemExit(f"{file} is not there")
    tensors, metadata = read_safetensors(file)
    described = description(run, metadata)
    if weights != "online":
        # Earlier versions described the online network in every file.
        described["model"] |= {"dim": dict.fromkeys(described["model"]["dim"], False), "loss_layers": []}
    network = Network(described["model"])
    network.load_state_dict(tensors)
    return network.eval(), described


def enlarge(frames, described):
    """States [B, h, w, C] as frames travel, as the network takes them: nearest neighbour, then cut to what it reads."""
    size, model, run = described["input"], described["model"], described["run"]
    whole = size.get("frame", {"height": run["frame_height"], "width": run["frame_width"]})
    sides = []
    for side in ("height", "width"):
        sides.append([(2 * at + 1) * whole[side] // (2 * size[side]) for at in range(model[side])])
    return frames[:, sides[0]][:, :, sides[1]]


def export(network, described, path):
    """Writes the network as ONNX: `states` u8 [B, H, W, C] to `q_values` f32 [B, A], for any B."""
    model = described["model"]
    blank = torch.zeros(2, model["height"], model["width"], model["input_channels"], dtype=torch.uint8)
    torch.onnx.export(
        network,
        (blank,),
        str(path),
        input_names=["states"],
        output_names=["q_values"],
        dynamic_shapes=({0: torch.export.Dim("batch")},),
        dynamo=True,
        external_data=False,
    )


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("run", type=Path, help="folder of the run, or a file of `driml evaluate --export`")
    arguments.add_argument("--checkpoint", type=Path, help="folder of one of its checkpoints [default: the newest]")
    arguments.add_argument("--weights", choices=["average", "online"], help="which weights [default: average, if it has some]")
    arguments.add_argument("--onnx", type=Path, metavar="FILE", help="write the network there")
    given = arguments.parse_args()
    network, described = load(given.run, given.checkpoint, given.weights)
    model = described["model"]
    shape = (1, model["height"], model["width"], model["input_channels"])
    with torch.no_grad():
        values = network(torch.zeros(shape, dtype=torch.uint8))[0].tolist()
    print(f"{sum(p.numel() for p in network.parameters())} parameters, states u8 {list(shape)}, {model['num_actions']} actions")
    print("values of a blank state:", " ".join(f"{value:.6f}" for value in values))
    if given.onnx:
        try:
            export(network, described, given.onnx)
        except ModuleNotFoundError as missing:
            sys.exit(f"--onnx needs the package {missing.name}: {sys.executable} -m pip install onnx onnxscript")
        print(f"wrote {given.onnx}")


if __name__ == "__main__":
    main()
