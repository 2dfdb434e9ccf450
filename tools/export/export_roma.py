#!/usr/bin/env python3
"""RoMa → warp.onnx: one direction, coarse pass at 560 × 560. Needs: pip install torch torchvision onnx onnxruntime romatch

    python tools/export/export_roma.py --weights roma_outdoor.pth --dinov2 dinov2_vitl14_pretrain.pth \\
        --out ~/.local/share/splatvk/models/roma
"""
import numpy as np
import romatch.models.matcher as matcher
import torch
from romatch.models.model_zoo.roma_models import roma_model
from torch.nn import functional as F

import common


def inverse(a):
    """Inverse of symmetric positive definite matrices by halves (Schur complements): ONNX has no Cholesky operator."""
    n = a.shape[-1]
    if n <= 50:
        # Newton's iteration doubles the digits each round. The start (Ben-Israel) converges for every such matrix, and the
        # eigenvalues lie between the noise 0.1 and n: log2(500) rounds to arrive, a few more to settle.
        eye = torch.eye(n, dtype=a.dtype)
        x = eye / a.abs().sum(-1).max()
        for _ in range(22):
            x = x @ (2 * eye - a @ x)
        return x
    h = n // 2
    # No transposes: both corners are slices, and ONNX Runtime fuses a transpose with a product for float32 only.
    p, q, t, s = a[..., :h, :h], a[..., :h, h:], a[..., h:, :h], a[..., h:, h:]
    p = inverse(p)
    pq, tp = p @ q, t @ p
    s = inverse(s - t @ pq)
    corner = -pq @ s
    upper = torch.cat([p - corner @ tp, corner], dim=-1)
    x = torch.cat([upper, torch.cat([-s @ tp, s], dim=-1)], dim=-2)
    # Errors grow by the square of |q| from level to level; one round of Newton's takes them back to rounding.
    return x @ (2 * torch.eye(n, dtype=a.dtype) - a @ x)


def gaussian_process(self, x, y, **_):
    b, _, h, w = x.shape
    f = self.get_pos_enc(y)
    x, y, f = self.reshape(x.float()), self.reshape(y.float()), self.reshape(f)
    # In float32 a Schur complement of 1600 tokens may lose its smallest eigenvalues, and Newton's iteration then diverges.
    a = self.K(y, y) + self.sigma_noise * torch.eye(h * w)[None]
    u = (inverse(a.double()) @ f.double()).float()
    return (self.K(x, y) @ u).permute(0, 2, 1).reshape(b, -1, h, w)


def local_correlation(f0, f1, radius, warp, **_):
    _, c, h, w = f0.shape
    n = 2 * radius + 1
    step = lambda size: torch.linspace(-2 * radius / size, 2 * radius / size, n)
    centre, found = warp.permute(0, 2, 3, 1)[:, :, :, None], []
    for row in step(h):
        # Row by row of the window: what is seen through a whole one takes 700 MB, twice.
        window = torch.stack([step(w), row.expand(n)], dim=-1).reshape(1, 1, 1, n, 2)
        seen = F.grid_sample(f1, (centre + window).reshape(1, h, w * n, 2), align_corners=False).reshape(c, h, w, n)
        found.append((f0[0, ..., None] / c ** 0.5 * seen).sum(dim=0))
    return torch.cat(found, dim=-1).permute(2, 0, 1)[None]


class Warp(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model, self.dino = model, model.encoder.dinov2_vitl14[0]

    def forward(self, im_A, im_B):
        pyramids = [self.model.encoder(im) for im in (im_A, im_B)]
        found = self.model.decoder(*pyramids)
        flow, certainty = found[1]["flow"], found[1]["certainty"]
        low = F.interpolate(found[16]["certainty"], size=certainty.shape[-2:], align_corners=False, mode="bilinear")
        return flow, certainty - 0.5 * low * (low < 0).to(low.dtype)


def build(args):
    size = args.size
    if args.random is None:
        read = lambda path: torch.load(path, map_location="cpu")
        model = roma_model(size, False, device="cpu", weights=read(args.weights), dinov2_weights=read(args.dinov2), use_custom_corr=False)
    else:
        load, torch.nn.Module.load_state_dict = torch.nn.Module.load_state_dict, lambda *_, **__: None
        model = roma_model(size, False, device="cpu", weights={}, dinov2_weights={}, use_custom_corr=False)
        torch.nn.Module.load_state_dict = load
        with torch.no_grad():
            for m in model.modules():
                # As after training: layers that start at zero would hide mistakes behind them.
                if isinstance(m, torch.nn.BatchNorm2d):
                    m.running_mean.normal_(std=0.1)
                    m.running_var.uniform_(0.8, 1.2)
            # The classes get distinct scores: an untrained classifier has ties, which rounding decides.
            model.decoder.embedding_decoder.to_out.weight.mul_(8)
    for m in list(model.modules()) + list(model.encoder.dinov2_vitl14[0].modules()):
        m.amp = False if hasattr(m, "amp") else getattr(m, "amp", False)
        if hasattr(m, "amp_dtype"):
            m.amp_dtype = torch.float32
    dino = model.encoder.dinov2_vitl14[0].float().eval()
    with torch.no_grad():
        table = dino.interpolate_pos_encoding(torch.zeros(1, (size // 14) ** 2 + 1, 1024), size, size)
    dino.interpolate_pos_encoding = lambda *_: table
    return model.eval()


def main():
    args = common.arguments(__doc__, weights={}, dinov2={}, size={"type": int, "default": 560, "help": "a multiple of 14"})
    if args.random is None and not (args.weights and args.dinov2):
        raise SystemExit("give --weights FILE and --dinov2 FILE, or --random SEED")
    model = build(args)
    weights = common.checkpoint(model)
    warp = Warp(model).eval()
    print("RoMa: %d weights" % sum(p.numel() for p in warp.parameters()))
    a, b = [common.normalise(p, [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]) for p in common.photo((args.size, args.size))]
    with torch.no_grad():
        wanted = warp(a, b)  # the package's own Gaussian process (Cholesky) and local correlation
    matcher.GP.forward, matcher.local_correlation = gaussian_process, local_correlation
    given = common.graph(args, "warp", warp, {"im_A": a, "im_B": b}, ["flow", "certainty"])
    for name, x, y in zip(("flow", "certainty"), given, wanted):
        error = abs(x - y.numpy()) / abs(y.numpy()).max()
        print("  %-24s against the package: largest %.1e, 99.9 %% below %.1e" % (name, error.max(), np.quantile(error, 0.999)))
        assert np.quantile(error, 0.999) < common.TOLERANCE, name
    common.adapter(args, "roma", weights)


main()
