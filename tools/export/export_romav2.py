#!/usr/bin/env python3
"""RoMa v2 → warp.onnx: both directions, one pass at a fixed size. Needs: pip install torch torchvision onnx onnxruntime romav2, and
romav2.0.1.pt from https://github.com/Parskatt/RoMaV2/releases (it holds the weights of DINOv3 too, under DINOv3's licence)

    python tools/export/export_romav2.py --checkpoint romav2.0.1.pt --out ~/.local/share/splatvk/models/romav2
"""
import contextlib
from functools import partial

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

import common

torch.cuda.is_available = torch.backends.mps.is_available = lambda: False  # the package chooses its device when it is imported

import romav2.local_correlation
import romav2.matcher
import romav2.refiner
import romav2.romav2
from romav2.vit.attention import LinearKMaskedBias
from romav2.vit.block import SelfAttentionBlock
from romav2.vit.layer_scale import LayerScale
from romav2.vit.patch_embed import PatchEmbed
from romav2.vit.rope import RopePositionEmbedding


class Dino(nn.Module):
    """DINOv3 ViT-L/16 under the names of its own state dict. The package takes it from torch.hub, but its matcher is made of the same
    blocks, so nothing needs to be fetched."""

    def __init__(self, dim=1024, depth=24, heads=16, storage=4):
        super().__init__()
        norm = partial(nn.LayerNorm, eps=1e-5)
        self.patch_embed = PatchEmbed(patch_size=16, embed_dim=dim)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.storage_tokens = nn.Parameter(torch.zeros(1, storage, dim))
        self.mask_token = nn.Parameter(torch.zeros(1, dim))  # for training only
        self.rope_embed = RopePositionEmbedding(dim, num_heads=heads, base=100, dtype=torch.float32)
        self.blocks = nn.ModuleList(
            SelfAttentionBlock(dim, heads, qkv_bias=True, norm_layer=norm, init_values=1e-5, mask_k_bias=True) for _ in range(depth))
        self.norm = norm(dim)

    def get_intermediate_layers(self, x, n):
        rope = self.rope_embed(H=x.shape[-2] // 16, W=x.shape[-1] // 16)
        x = torch.cat([self.cls_token, self.storage_tokens, self.patch_embed(x)], dim=1)
        found = []
        for k in range(max(n) + 1):
            x = self.blocks[k](x, rope)
            if k in n:
                found.append(self.norm(x)[:, 1 + self.storage_tokens.shape[1]:])
        return found


def grid(_, h, w):
    """A constant: as nodes, linspace would round otherwise."""
    x, y = [np.linspace(1 / n - 1, 1 - 1 / n, n, dtype=np.float32) for n in (int(w), int(h))]
    return torch.from_numpy(np.stack(np.meshgrid(x, y), axis=-1)[None])


def local_correlation(f0, f1, local_radius, warp, **_):
    c, h, w = [int(n) for n in f0.shape[1:]]
    n = 2 * local_radius + 1
    steps = lambda size: np.linspace(-2 * local_radius / size, 2 * local_radius / size, n, dtype=np.float32)
    rows = []
    # One GridSample for each row of the window: the whole window of 7 × 7 would take a gigabyte at 160 × 160.
    for y in steps(h):
        row = torch.from_numpy(np.stack([steps(w), np.full(n, y)], axis=-1).reshape(1, 1, 1, n, 2))
        seen = F.grid_sample(f1, (warp[:, :, :, None] + row).reshape(1, h, w * n, 2), align_corners=False)
        rows.append((f0[..., None] / c ** 0.5 * seen.reshape(1, c, h, w, n)).sum(dim=1))
    return torch.cat(rows, dim=-1).permute(0, 3, 1, 2)


def interpolate(original, **options):
    """The matcher gives one channel of confidence, refiners four. Widened here, no refiner writes into a slice (ScatterND)."""
    warp, confidence = original(**options)
    return warp, confidence if confidence.shape[-1] == 4 else confidence * torch.tensor([1.0, 0, 0, 0])


class Warp(nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, img_A, img_B):
        found = type(self.model).forward.__wrapped__(self.model, img_A, img_B)  # without inference_mode
        said = [(found["warp_" + way], found["confidence_" + way][..., :1].sigmoid()) for way in ("AB", "BA")]
        return (*said[0], *said[1])


def nothing(*_, **__):
    return contextlib.nullcontext()


def untrained(model):
    """As after training: layers that start at zero, at one or alike for all tokens would hide mistakes behind them."""
    for m in model.modules():
        if isinstance(m, LayerScale):
            m.gamma.uniform_(0.2, 0.6)
        elif isinstance(m, LinearKMaskedBias):
            m.bias_mask.fill_(1).view(3, -1)[1] = 0
        elif isinstance(m, (nn.LayerNorm, nn.BatchNorm2d)):
            m.weight.normal_(1, 0.1)
            m.bias.normal_(0, 0.1)
        if isinstance(m, nn.BatchNorm2d):
            m.running_mean.normal_(0, 0.1)
            m.running_var.uniform_(0.8, 1.2)
        if isinstance(m, SelfAttentionBlock):
            m.attn.qkv.weight.mul_(2)
    model.f.cls_token.normal_()
    model.f.storage_tokens.normal_()
    # Untrained, all tokens are nearly alike, and so is every pixel's answer. Each of these layers gets, once, weights with which its
    # channels have the given mean and spread on the photos. Around 1, ReLU multiplies rounding errors less than around 0.
    parts = (model.matcher.head, model.refiners)
    wanted = {m: (1.0, 1.0) for part in parts for m in part.modules() if isinstance(m, nn.Conv2d)}
    wanted.update({model.matcher.mv_vit.output_projector: (0.0, 1.0), model.matcher.head.scratch.output_conv2[2]: (0.0, 0.4)})
    for refiner in model.refiners.values():
        wanted.update({refiner.proj: (0.0, 1.0), refiner.warp_head: (0.0, 2.0), refiner.confidence_head: (0.0, 0.1)})

    def spread(layer, given, out):
        if layer in wanted:
            mean, std = wanted.pop(layer)
            rows = out.float().transpose(1 if isinstance(layer, nn.Conv2d) else -1, -1).flatten(0, -2)
            factor = std / rows.std(dim=0)
            layer.weight.mul_(factor.view(-1, *[1] * (layer.weight.dim() - 1)))
            if layer.bias is not None:
                layer.bias.sub_(rows.mean(dim=0)).mul_(factor).add_(mean)
            return layer.forward(*given)

    hooks = [layer.register_forward_hook(spread) for layer in list(wanted)]
    autocast, torch.autocast = torch.autocast, nothing
    model.f.float()
    Warp(model)(*common.photo((320, 320)))
    model.f.bfloat16()
    torch.autocast = autocast
    for hook in hooks:
        hook.remove()


def build(args):
    torch.hub.load = lambda *_, **__: Dino()
    read = lambda *_, **__: None if args.random is not None else torch.load(args.checkpoint, map_location="cpu", weights_only=True)
    torch.hub.load_state_dict_from_url = read
    romav2.local_correlation.local_corr = None  # a kernel for CUDA
    network = romav2.romav2.RoMaV2
    if args.random is not None:
        network.load_state_dict = lambda *_: None
    model = network(network.Cfg(setting="base"))
    model.H_lr = model.W_lr = args.size
    model.bidirectional = True
    if args.random is not None:
        with torch.no_grad():
            untrained(model)
    return model


def float32(model, size):
    """The package computes in bfloat16 where it can, ONNX Runtime on a CPU cannot. What the package keeps in bfloat16, the weights of
    DINOv3 and its matcher's rotary table, stays rounded so."""
    for m in model.modules():
        if isinstance(m, RopePositionEmbedding):
            table = tuple(t.float() for t in m(H=size // 16, W=size // 16))
            m.forward = lambda table=table, **_: table
    torch.autocast = nothing
    return model.float()


def against(given, wanted, text, limit):
    for name, x in given.items():
        y = wanted[name].numpy()
        error = abs(x - y) / abs(y).max()
        print("  %-24s %s: largest %.1e, 99.9 %% below %.1e" % (name, text, error.max(), np.quantile(error, 0.999)))
        assert np.quantile(error, 0.999) < limit, name


def main():
    args = common.arguments(__doc__, checkpoint={}, size={
        "type": int, "default": 640, "help": "a multiple of 32; the package's settings are 320 (turbo), 512 (fast) and 640 (base)"})
    if args.random is None and not args.checkpoint:
        raise SystemExit("give --checkpoint FILE, or --random SEED")
    if args.size % 32:
        raise SystemExit("--size must be a multiple of 32")
    model = build(args)
    a, b = common.photo((args.size, args.size))
    own = model.match(a, b)
    own32 = float32(model, args.size).match(a, b)
    weights = common.checkpoint(model)
    del model.f.blocks[max(model.cfg.descriptor.layer_idx) + 1:]  # nothing asks them
    romav2.matcher.get_normalized_grid = romav2.refiner.get_normalized_grid = grid
    romav2.refiner.local_correlation = local_correlation
    romav2.romav2._interpolate_warp_and_confidence = partial(interpolate, romav2.romav2._interpolate_warp_and_confidence)
    outputs = ["warp_AB", "overlap_AB", "warp_BA", "overlap_BA"]
    given = dict(zip(outputs, common.graph(args, "warp", Warp(model), {"img_A": a, "img_B": b}, outputs)))
    against(given, own32, "against the package in float32", common.TOLERANCE)
    against(given, own, "against the package in bfloat16", np.inf)
    common.adapter(args, "roma", weights)


main()
