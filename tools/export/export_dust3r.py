#!/usr/bin/env python3
"""DUSt3R → encoder.onnx, decoder.onnx, for one input size. Needs: pip install torch onnx onnxruntime mini-dust3r (or NAVER's
dust3r on PYTHONPATH), and a checkpoint from https://github.com/naver/dust3r (CC BY-NC-SA 4.0).

    python tools/export/export_dust3r.py --checkpoint DUSt3R_ViTLarge_BaseDecoder_512_dpt.pth --out ~/.local/share/splatvk/models/dust3r
"""
import sys
import types

import torch

import common

try:
    from dust3r.model import AsymmetricCroCo3DStereo
except ImportError:
    # The package's start page pulls in viewers that an export has no use for.
    for name in ("rerun", "gradio", "gradio_rerun"):
        sys.modules.setdefault(name, types.ModuleType(name))
    from mini_dust3r.model import AsymmetricCroCo3DStereo


class Rope(torch.nn.Module):
    """RoPE2D for one grid: cosines and sines are constants, since the original sizes its cache by the data."""

    def __init__(self, rope, rows, columns, width):
        super().__init__()
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        frequency = 1.0 / (rope.base ** (torch.arange(0, width // 2, 2).float() / (width // 2)))
        for name, at in (("y", y), ("x", x)):
            angle = at.reshape(-1, 1).float() * frequency
            angle = torch.cat([angle, angle], dim=-1)[None, None]
            self.register_buffer("cos_" + name, angle.cos())
            self.register_buffer("sin_" + name, angle.sin())

    @staticmethod
    def turn(v, cos, sin):
        a, b = v.chunk(2, dim=-1)
        return v * cos + torch.cat([-b, a], dim=-1) * sin

    def forward(self, tokens, positions):
        y, x = tokens.chunk(2, dim=-1)
        return torch.cat([self.turn(y, self.cos_y, self.sin_y), self.turn(x, self.cos_x, self.sin_x)], dim=-1)


class Encoder(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.patches, self.blocks, self.norm = model.patch_embed, model.enc_blocks, model.enc_norm

    def forward(self, image):
        tokens = self.patches.proj(image).flatten(2).transpose(1, 2)
        for block in self.blocks:
            tokens = block(tokens, None)
        return self.norm(tokens)


class Decoder(torch.nn.Module):
    def __init__(self, model, height, width):
        super().__init__()
        self.model, self.size = model, (height, width)

    def forward(self, feat1, feat2):
        m = self.model
        one, two = m.decoder_embed(feat1), m.decoder_embed(feat2)
        states1, states2 = [feat1, one], [feat2, two]
        for left, right in zip(m.dec_blocks, m.dec_blocks2):
            one, two = left(one, two, None, None)[0], right(two, one, None, None)[0]
            states1.append(one)
            states2.append(two)
        # The embedded tokens are the decoder's input, not a state that the heads look at.
        del states1[1], states2[1]
        states1[-1], states2[-1] = m.dec_norm(states1[-1]), m.dec_norm(states2[-1])
        a = m.downstream_head1([t.float() for t in states1], self.size)
        b = m.downstream_head2([t.float() for t in states2], self.size)
        out = [a["pts3d"], a["conf"], b["pts3d"], b["conf"]]
        if "desc" in a:
            out += [a["desc"], b["desc"], a["desc_conf"], b["desc_conf"]]
        return tuple(out)


NAMES = ["pts3d_1", "conf_1", "pts3d_2", "conf_2", "desc_1", "desc_2", "desc_conf_1", "desc_conf_2"]


def run(args, model, family):
    """Writes both graphs of a DUSt3R-like model."""
    width, height = args.size
    weights = common.checkpoint(model)
    print("%s: %d weights" % (family, sum(p.numel() for p in model.parameters())))
    images = [common.normalise(p, [0.5] * 3, [0.5] * 3) for p in common.photo((width, height))]
    shape = torch.tensor([[height, width]])
    with torch.no_grad():
        original = model({"img": images[0], "true_shape": shape, "instance": ["0"], "idx": 0},
                         {"img": images[1], "true_shape": shape, "instance": ["1"], "idx": 1})
    heads = model.enc_blocks[0].attn.num_heads, model.dec_blocks[0].attn.num_heads
    dims = model.enc_embed_dim // heads[0], model.dec_embed_dim // heads[1]
    assert dims[0] == dims[1], "one rotation table serves both"
    rope = Rope(model.rope, height // 16, width // 16, dims[0])
    for module in model.modules():
        if hasattr(module, "rope") and module is not model:
            module.rope = rope
    torch.expm1 = lambda x: torch.exp(x) - 1  # the exporter does not know it; distances are not near zero
    encoder = Encoder(model)
    feat1 = common.graph(args, "encoder", encoder, {"image": images[0]}, ["feat"])[0]
    with torch.no_grad():
        feat2 = encoder(images[1])
    decoder = Decoder(model, height, width).eval()
    names = NAMES if "desc" in original[0] else NAMES[:4]
    given = common.graph(args, "decoder", decoder, {"feat1": torch.from_numpy(feat1), "feat2": feat2}, names)
    wanted = [original[0]["pts3d"], original[0]["conf"], original[1]["pts3d_in_other_view"], original[1]["conf"]]
    if "desc" in original[0]:
        wanted += [original[0]["desc"], original[1]["desc"], original[0]["desc_conf"], original[1]["desc_conf"]]
    for name, a, b in zip(names, given, wanted):
        error = float(abs(a - b.numpy()).max() / abs(b.numpy()).max())
        print("  %-24s against the whole model: %.1e" % (name, error))
        assert error < common.TOLERANCE, name
    common.adapter(args, family, weights)


def arguments(text):
    args = common.arguments(text, checkpoint={}, reduced={"action": "store_true", "help": "a small network of the same build, for tests"},
                            size={"type": int, "nargs": 2, "default": [512, 384], "metavar": ("W", "H")})
    if args.random is None and not args.checkpoint:
        raise SystemExit("give --checkpoint FILE, or --random SEED")
    return args


def settings(args):
    """Those of the released 512 DPT models."""
    depth = {"enc_depth": 4, "dec_depth": 12} if args.reduced else {"enc_depth": 24, "dec_depth": 12}
    return dict(pos_embed="RoPE100", img_size=(512, 512), head_type="dpt", output_mode="pts3d",
                depth_mode=("exp", -float("inf"), float("inf")), conf_mode=("exp", 1, float("inf")), enc_embed_dim=1024,
                enc_num_heads=16, dec_embed_dim=768, dec_num_heads=12, patch_embed_cls="PatchEmbedDust3R",
                landscape_only=False, **depth)


def main():
    args = arguments(__doc__)
    if args.random is not None:
        model = AsymmetricCroCo3DStereo(**settings(args))
    else:
        model = AsymmetricCroCo3DStereo.from_pretrained(args.checkpoint, landscape_only=False)
    run(args, model.eval(), "dust3r")


if __name__ == "__main__":
    main()
