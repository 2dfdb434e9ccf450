#!/usr/bin/env python3
"""VGGT → views.onnx: any number of photos of one size, cameras relative to the first. Needs: pip install torch torchvision onnx
onnxruntime safetensors; the network's code, from https://github.com/facebookresearch/vggt on PYTHONPATH or the copy in
pip install --no-deps ffgs==0.1.0.dev1 einops (CC BY-NC 4.0, as the weights); and model.pt or model.safetensors of VGGT-1B.

    python tools/export/export_vggt.py --checkpoint model.pt --out ~/.local/share/splatvk/models/vggt
"""
import torch

import common
from multiview import Dense, Rope, awake, block, graph, grid, spread, state


class Views(torch.nn.Module):
    def __init__(self, model, height, width):
        super().__init__()
        a, dino = model.aggregator, model.aggregator.patch_embed
        self.a, self.dino, self.camera = a, dino, model.camera_head
        self.dense = Dense(model.depth_head, model.depth_head._apply_pos_embed, height, width)
        self.layers = model.depth_head.intermediate_layer_idx
        rows, columns = height // 14, width // 14
        with torch.no_grad():
            table = dino.interpolate_pos_encoding(torch.zeros(1, 1 + rows * columns, dino.embed_dim), height, width).clone()
        self.register_buffer("table", table)
        self.rope = Rope(a.rope.base_frequency, grid(rows, columns, a.patch_start_idx), dino.embed_dim // a.frame_blocks[0].attn.num_heads)

    def patches(self, photos):
        d = self.dino
        x = d.patch_embed.proj((photos - self.a._resnet_mean[0]) / self.a._resnet_std[0]).flatten(2).transpose(1, 2) + self.table[:, 1:]
        first = torch.cat([d.cls_token + self.table[:, :1], d.register_tokens], dim=1)
        x = torch.cat([first.expand(photos.shape[0], -1, -1), x], dim=1)
        for b in d.blocks:
            x = block(b, x)
        return d.norm(x)[:, first.shape[1]:]

    def forward(self, images):
        photos, a = images[0], self.a
        special = torch.cat([a.camera_token, a.register_token], dim=2)[0]
        # One set of tokens marks the first photo, another one the others.
        others = (torch.arange(photos.shape[0]) > 0)[:, None, None]
        x = torch.cat([torch.where(others, special[1:], special[:1]), self.patches(photos)], dim=1)
        tokens, width = int(x.shape[1]), int(x.shape[2])
        kept = []
        for k, (alone, together) in enumerate(zip(a.frame_blocks, a.global_blocks)):
            local = block(alone, x, self.rope)
            x = block(together, local.reshape(1, -1, width), self.rope).reshape(-1, tokens, width)
            if k in self.layers:
                kept.append(torch.cat([local, x], dim=-1))
        depth, confidence = self.dense([f[:, special.shape[1]:] for f in kept])
        return depth[None, ..., None], confidence[None], self.poses(torch.cat([local[:, 0], x[:, 0]], dim=-1)[None])

    def poses(self, x):
        c = self.camera
        x = c.token_norm(x)
        code, known = 0, c.empty_pose_tokens
        for _ in range(4):
            shift, scale, gate = c.poseLN_modulation(c.embed_pose(known)).chunk(3, dim=-1)
            t = x + gate * (c.adaln_norm(x) * (1 + scale) + shift)
            for b in c.trunk:
                t = block(b, t)
            known = code = code + c.pose_branch(c.trunk_norm(t))
        return torch.cat([code[..., :7], code[..., 7:].relu()], dim=-1)


class Vggt(torch.nn.Module):
    """VGGT-1B without its heads for points and tracks, which splatvk does not ask."""

    def __init__(self, layers):
        super().__init__()
        try:
            from vggt.heads.camera_head import CameraHead
            from vggt.heads.dpt_head import DPTHead
            from vggt.models.aggregator import Aggregator
        except ImportError:
            from ffgs.models.anysplat.vggt.heads.camera_head import CameraHead
            from ffgs.models.anysplat.vggt.heads.dpt_head import DPTHead
            from ffgs.models.anysplat.vggt.models.aggregator import Aggregator
        small = {"depth": layers} if layers else {}
        self.aggregator = Aggregator(img_size=518, patch_size=14, embed_dim=1024, **small)
        self.camera_head = CameraHead(dim_in=2048, **({"trunk_depth": 1} if layers else {}))
        self.depth_head = DPTHead(dim_in=2048, output_dim=2, activation="exp", conf_activation="expp1")
        if layers:
            self.depth_head.intermediate_layer_idx = [layers - 4, layers - 3, layers - 2, layers - 1]
            self.aggregator.patch_embed.blocks = self.aggregator.patch_embed.blocks[:4]

    def forward(self, images):
        tokens, start = self.aggregator(images)
        depth, confidence = self.depth_head(tokens, images=images, patch_start_idx=start)
        return depth, confidence, self.camera_head(tokens)[-1]


def main():
    args = common.arguments(
        __doc__, checkpoint={}, reduced={"action": "store_true", "help": "4 pairs of layers of 24, and few of the others, for tests"},
        views={"type": int, "default": 4, "help": "photos of the reference; the graph takes any number"},
        size={"type": int, "nargs": 2, "default": [518, 392], "metavar": ("W", "H"), "help": "multiples of 14"})
    if args.random is None and not args.checkpoint:
        raise SystemExit("give --checkpoint FILE, or --random SEED")
    width, height = args.size
    images = torch.stack(common.photo((width, height), args.views), dim=1)
    model = Vggt(4 if args.reduced else None).eval()
    with torch.no_grad():
        if args.random is None:
            missing, _ = model.load_state_dict(state(args.checkpoint), strict=False)
            assert not missing, "the checkpoint lacks %s" % missing[:3]
        else:
            awake(model)
            spread(lambda: model(images), {
                model.depth_head.scratch.output_conv2[-1]: ([0.5, 0.5], 0.5),
                model.camera_head.pose_branch.fc2: ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.25, 0.25, 0.25], 0.05),
            })
        originals = {n: model(images[:, :n]) for n in sorted({args.views, 1, 2}, reverse=True)}
        print("poses:\n%s" % originals[args.views][2][0])
    weights = common.checkpoint(model)
    graph(args, Views(model, height, width).eval(), images, "images", ["depth", "depth_conf", "pose_enc"], originals)
    common.adapter(args, "vggt", weights)


if __name__ == "__main__":
    main()
