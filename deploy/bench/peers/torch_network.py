"""The network in PyTorch: torso, C51 head and DIM heads, with the names and shapes that deploy/docs/src/reference/parity.md gives.

It is driml_model's network layer by layer; `torch_update.py --check` compares what comes out with float64 references.
"""

import torch
from torch import nn
from torch.nn import functional


class Block(nn.Module):
    """A DIM head: out(relu(hidden(x))) + skip(x)."""

    def __init__(self, inputs, outputs, skip_bias=False):
        super().__init__()
        self.hidden = nn.Linear(inputs, outputs)
        self.out = nn.Linear(outputs, outputs)
        self.skip = nn.Linear(inputs, outputs, bias=skip_bias)

    def forward(self, x):
        return self.out(functional.relu(self.hidden(x))) + self.skip(x)


class Network(nn.Module):
    """`config` is a parity case's; `pairs` are the DIM pairs for which heads are built, such as {"4t4"}."""

    def __init__(self, config, pairs=frozenset()):
        super().__init__()
        obs, model = config["obs"], config["model"]
        self.atoms, self.actions = config["atoms"], config["actions"]
        self.register_buffer(
            "support", torch.linspace(config["v_min"], config["v_max"], self.atoms), persistent=False
        )
        self.torso = nn.ModuleDict()
        height, width, channels = obs["height"], obs["width"], obs["channels"]
        for index, (out, kernel, stride) in enumerate(model["conv"], 1):
            self.torso[f"conv{index}"] = nn.Conv2d(channels, out, kernel, stride)
            height, width, channels = (height - kernel) // stride + 1, (width - kernel) // stride + 1, out
        self.torso["fc"] = nn.Linear(channels * height * width, model["hidden"])
        self.head = nn.Linear(model["hidden"], self.actions * self.atoms)
        widths, embed, rkhs = {"3": channels, "4": model["hidden"]}, model["action_embed"], model["rkhs"]
        self.dim = nn.ModuleDict()
        if pairs:
            self.dim["action"] = Block(self.actions, embed, skip_bias=True)
        for level in sorted({pair[0] for pair in pairs}):
            self.dim["psi" + level] = Block(widths[level] + embed, rkhs)
        for level in sorted({pair[2] for pair in pairs}):
            self.dim["phi" + level] = Block(widths[level], rkhs)

    def features(self, frames):
        """f3 [B, c, h, w] after its ReLU and f4 [B, hidden] before it, of bytes [B, C, H, W] in any memory format."""
        maps = frames.float().div_(255)
        for name, layer in self.torso.items():
            if name != "fc":
                maps = functional.relu(layer(maps))
        return maps, self.torso["fc"](maps.flatten(1))

    def logits(self, f4):
        """[B, A, N]."""
        return self.head(functional.relu(f4)).view(-1, self.actions, self.atoms)

    def q_values(self, logits):
        """[B, A]."""
        return (logits.softmax(-1) * self.support).sum(-1)

    def vectors(self, head, features, action=None):
        """Psi, with an action [B], or Phi: [B, R] of f4, [B, L, R] of f3."""
        f3, f4 = features
        x = f4 if head.endswith("4") else f3.flatten(2).transpose(1, 2)
        if action is not None:
            embedded = self.dim["action"](functional.one_hot(action, self.actions).float())
            if x.dim() == 3:
                embedded = embedded.unsqueeze(1).expand(-1, x.shape[1], -1)
            x = torch.cat([x, embedded], -1)
        return self.dim[head](x)
