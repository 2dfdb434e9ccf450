"""What networks that see all photos at once have in common: transformer blocks, rotary tables and the DPT head for one size of
photo, and tests of graphs that take any number of them."""
import sys

import numpy as np
import torch
from torch.nn import functional as F

import common


class Rope(torch.nn.Module):
    """Rotary position embedding of one photo's tokens at `positions` [tokens, 2], the same for every photo: constants, since
    the original sizes its cache by the data."""

    def __init__(self, frequency, positions, width):
        super().__init__()
        powers = 1.0 / (frequency ** (torch.arange(0, width // 2, 2).float() / (width // 2)))
        y, x = (positions[:, k, None].float() * powers for k in (0, 1))
        angle = torch.cat([y, y, x, x], dim=-1)[:, None]
        self.register_buffer("cos", angle.cos())
        self.register_buffer("sin", angle.sin())

    def forward(self, v):
        """[b, photos × tokens, heads, width]"""
        shape = v.shape
        v = v.reshape(-1, self.cos.shape[0], int(shape[2]), self.cos.shape[2])
        a, b, c, d = v.chunk(4, dim=-1)
        return (v * self.cos + torch.cat([-b, a, -d, c], dim=-1) * self.sin).reshape(shape)


def grid(rows, columns, special):
    """Positions of tokens: `special` ones at 0, then the patches from 1."""
    y, x = torch.meshgrid(torch.arange(rows) + 1, torch.arange(columns) + 1, indexing="ij")
    return torch.cat([torch.zeros(special, 2, dtype=torch.int64), torch.stack([y, x], dim=-1).reshape(-1, 2)])


def attention(m, x, rope):
    batch, tokens, width = x.shape
    q, k, v = m.qkv(x).reshape(batch, tokens, 3, m.num_heads, int(width) // m.num_heads).unbind(2)
    q, k = m.q_norm(q), m.k_norm(k)
    if rope is not None:
        q, k = rope(q), rope(k)
    # Head by head: the scores of all tokens of all photos are by far the largest tensor, and need not exist for all heads at once.
    heads = zip(*(t.unbind(2) for t in (q * m.scale, k, v)))
    return m.proj(torch.cat([(a @ b.transpose(1, 2)).softmax(dim=-1) @ c for a, b, c in heads], dim=-1))


def block(b, x, rope=None):
    x = x + b.ls1(attention(b.attn, b.norm1(x), rope))
    return x + b.ls2(b.mlp(b.norm2(x)))


class Dense(torch.nn.Module):
    """DPT head for one grid of patches: sizes and with them the sine tables are constants."""

    def __init__(self, head, table, height, width, patch=14):
        super().__init__()
        s = head.scratch
        self.norm, self.projects, self.resizes = head.norm, head.projects, head.resize_layers
        self.adapt = torch.nn.ModuleList([s.layer1_rn, s.layer2_rn, s.layer3_rn, s.layer4_rn])
        self.refine = torch.nn.ModuleList([s.refinenet1, s.refinenet2, s.refinenet3, s.refinenet4])
        self.out1, self.out2 = s.output_conv1, s.output_conv2
        self.size, self.rows, self.columns, self.tables = (height, width), height // patch, width // patch, {}
        sizes = [(p.out_channels, self.rows, self.columns) for p in self.projects] + [(self.out1.out_channels, height, width)]
        for c, h, w in sizes:
            # Half of the channels know the column only, the others the row: a strip of each is all there is to store.
            whole = table(torch.zeros(1, c, h, w), width, height)
            across, down = whole[:, :c // 2, :1], whole[:, c // 2:, :, :1]
            assert torch.equal(whole, torch.cat([across.expand(-1, -1, h, -1), down.expand(-1, -1, -1, w)], dim=1))
            self.tables[c, h] = across.clone(), down.clone()

    def placed(self, x):
        c, h, w = (int(n) for n in x.shape[1:])
        across, down = self.tables[c, h]
        return x + torch.cat([across.expand(-1, -1, h, -1), down.expand(-1, -1, -1, w)], dim=1)

    def forward(self, features):
        """Four of [photos, patches, channels] → [photos, H, W] depth and confidence."""
        maps = []
        for x, project, resize, adapt in zip(features, self.projects, self.resizes, self.adapt):
            x = self.norm(x).transpose(1, 2).reshape(-1, int(x.shape[2]), self.rows, self.columns)
            maps.append(adapt(resize(self.placed(project(x)))))
        x = self.refine[3](maps[3], size=(self.rows, self.columns))
        for k, times in ((2, 2), (1, 4), (0, 8)):
            x = self.refine[k](x, maps[k], size=(times * self.rows, times * self.columns))
        x = F.interpolate(self.out1(x), size=self.size, mode="bilinear", align_corners=True)
        x = self.out2(self.placed(x)).exp()
        return x[:, 0], x[:, 1] + 1


def awake(model):
    """Untrained parameters that start at a constant or next to nothing would prove nothing, nor would attention to all alike."""
    for name, p in model.named_parameters():
        if name.endswith("qkv.weight"):
            p.data.mul_(4)
        if p.std() > 1e-4:
            continue
        elif "gamma" in name:
            p.data.uniform_(0.2, 0.8)  # LayerScale
        elif p.mean().abs() > 0.5:
            p.data.uniform_(0.7, 1.3)  # LayerNorm
        else:
            p.data.normal_(std=0.1)


def spread(run, wishes):
    """Scales last layers until an untrained network's outputs spread as trained ones: layer → mean of each channel, deviation."""
    seen = {}

    def look(layer, _, out):
        seen.setdefault(layer, out.clone())

    hooks = [layer.register_forward_hook(look) for layer in wishes]
    run()
    for layer, (mean, deviation) in wishes.items():
        out = seen[layer]
        out = (out.movedim(1, -1) if out.ndim == 4 else out).flatten(0, -2)
        scale = deviation / out.std(dim=0)
        layer.weight.mul_(scale.view(-1, *[1] * (layer.weight.ndim - 1)))
        layer.bias.copy_((layer.bias - out.mean(dim=0)) * scale + torch.tensor(mean))
    for h in hooks:
        h.remove()


def state(path):
    if str(path).endswith(".safetensors"):
        from safetensors.torch import load_file
        return load_file(path)
    return torch.load(path, map_location="cpu", weights_only=True)


def graph(args, module, images, name, outputs, originals):
    """common.graph with a free number of photos; then ONNX Runtime against `originals`, number of photos → what the package's own
    module says about them."""
    common.graph(args, "views", module, {name: images}, outputs, {n: {1: "views"} for n in [name] + outputs})
    session = common.session(args.out / "views.onnx")
    for count, wanted in originals.items():
        given = session.run(outputs, {name: images[:, :count].numpy()})
        errors = [float(np.abs(a - b.numpy()).max() / b.abs().max()) for a, b in zip(given, wanted)]
        print("  %d photos against the package: %s" % (count, ", ".join("%s %.1e" % pair for pair in zip(outputs, errors))))
        if not max(errors) < common.TOLERANCE or any(a.shape != tuple(b.shape) for a, b in zip(given, wanted)):
            sys.exit("the graph differs from the package's own module")
