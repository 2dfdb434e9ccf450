#!/usr/bin/env python3
"""Depth Anything 3 → views.onnx: any number of photos of one size. Needs: pip install torch torchvision onnx onnxruntime einops
addict omegaconf safetensors; pip install --no-deps depth-anything-3 (0.1.1; what else it asks for serves its viewers), and
model.safetensors from https://huggingface.co/depth-anything (DA3-SMALL, DA3-BASE: Apache-2.0; DA3-LARGE, DA3-GIANT: CC BY-NC 4.0).

    python tools/export/export_da3.py --checkpoint model.safetensors --out ~/.local/share/splatvk/models/da3
"""
import sys

import torch

import common
from multiview import Dense, Rope, awake, block, graph, grid, spread, state

sys.modules.setdefault("xformers", None)  # the package's own SwiGLU instead, which the exporter can follow

from depth_anything_3.cfg import create_object, load_config
from depth_anything_3.registry import MODEL_REGISTRY

OUTPUTS = ["depth", "depth_conf", "extrinsics", "intrinsics"]


def reference(x):
    """The package's "saddle_balanced": the photo that is nearest to the middle of all in three respects. x: [photos, C]"""
    count = x.shape[0]
    norm = x.norm(dim=-1)
    unit = x / norm[:, None]
    alike = ((unit @ unit.T).sum(dim=-1) - 1) / (count - 1)
    far = 0
    for m in (alike, norm, unit.var(dim=-1)):
        low, high = m.min(), m.max()
        far = far + ((m - low) / (high - low + 1e-8) - 0.5).abs()
    # Of one or two photos it takes the first.
    return far.argmin() * (torch.ones_like(norm).sum() > 2).to(torch.int64), far


class Views(torch.nn.Module):
    def __init__(self, net, height, width):
        super().__init__()
        vit = net.backbone.pretrained
        assert vit.cat_token and vit.register_tokens is None and vit.rope is not None
        self.vit, self.camera, self.layers, self.size = vit, net.cam_dec, net.backbone.out_layers, (height, width)
        self.dense = Dense(net.head, net.head._add_pos_embed, height, width)
        rows, columns = height // 14, width // 14
        with torch.no_grad():
            table = vit.interpolate_pos_encoding(torch.zeros(1, 1 + rows * columns, vit.embed_dim), height, width).clone()
        self.register_buffer("table", table)
        at, head = grid(rows, columns, 1), vit.embed_dim // vit.num_heads
        # Blocks that see all photos know only which token is the camera's.
        self.alone, self.together = (Rope(vit.rope.base_frequency, p, head) for p in (at, at.clamp(max=1)))

    def forward(self, image):
        v, photos = self.vit, image[0]
        count = photos.shape[0]
        x = v.patch_embed.proj(photos).flatten(2).transpose(1, 2)
        x = torch.cat([v.cls_token.expand(count, -1, -1), x], dim=1) + self.table
        tokens, width = int(x.shape[1]), int(x.shape[2])
        kept, chosen, local = [], None, x
        for k, b in enumerate(v.blocks):
            if k == v.alt_start - 1:
                chosen, _ = reference(x[:, 0])
            if k == v.alt_start:
                # The package brings the chosen photo to the front, where a camera token of its own waits, and later all back
                # to their places. Nothing else depends on the order, so here the token goes to the photo.
                camera = torch.where((torch.arange(count) == chosen)[:, None, None], v.camera_token[:, :1], v.camera_token[:, 1:])
                x = torch.cat([camera, x[:, 1:]], dim=1)
            turned = k >= v.rope_start
            if k >= v.alt_start and k % 2 == 1:
                x = block(b, x.reshape(1, -1, width), self.together if turned else None).reshape(-1, tokens, width)
            else:
                x = local = block(b, x, self.alone if turned else None)
            if k in self.layers:
                kept.append((local, x))
        depth, confidence = self.dense([torch.cat([a[:, 1:], v.norm(b)[:, 1:]], dim=-1) for a, b in kept])
        extrinsics, intrinsics = self.cameras(self.camera(torch.cat([kept[-1][0][:, 0], kept[-1][1][:, 0]], dim=-1)[None])[0])
        return depth[None], confidence[None], extrinsics[None], intrinsics[None]

    def cameras(self, code):
        """Translation, quaternion (x, y, z, w) camera → world, fields of view down and across → world → camera, intrinsics."""
        t, q, (high, wide) = code[:, :3], code[:, 3:7], code[:, 7:].unbind(1)
        x, y, z, w = (q / (q * q).sum(dim=1, keepdim=True).sqrt()).unbind(1)
        turn = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w),
                            2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w),
                            2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], dim=1).reshape(-1, 3, 3)
        height, width = self.size
        fy, fx = (0.5 * n / (0.5 * angle).tan().clamp(min=1e-6) for n, angle in ((height, high), (width, wide)))
        none, one = torch.zeros_like(fx), torch.ones_like(fx)
        lens = torch.stack([fx, none, one * (0.5 * width), none, fy, one * (0.5 * height), none, none, one], dim=1).reshape(-1, 3, 3)
        return torch.cat([turn, -turn @ t[:, :, None]], dim=2), lens


def build(args, images):
    config = load_config(MODEL_REGISTRY["da3-" + args.model])
    config.gs_head = config.gs_adapter = None  # Gaussians
    net = create_object(config).eval()
    net.cam_enc = None  # known cameras
    if args.random is None:
        values = {k.removeprefix("model."): v for k, v in state(args.checkpoint).items()}
        # The ray head, not exported, shares some weights between its levels, of which a checkpoint holds one copy.
        missing = [k for k in net.load_state_dict(values, strict=False).missing_keys if "_aux." not in k]
        assert not missing, "the checkpoint lacks %s; is it of --model %s?" % (missing[:3], args.model)
        return net
    awake(net)
    camera = net.cam_dec
    spread(lambda: net(images), {
        net.head.scratch.output_conv2[-1]: ([0.5, 0.5], 0.5), camera.fc_t: ([0.0] * 3, 0.5),
        camera.fc_qvec: ([0.0, 0.0, 0.0, 1.0], 0.2), camera.fc_fov[0]: ([0.8, 1.0], 0.1),
    })
    return net


def main():
    args = common.arguments(
        __doc__, model={"default": "base", "choices": ["small", "base", "large", "giant"]}, checkpoint={},
        views={"type": int, "default": 4, "help": "photos of the reference; the graph takes any number"},
        size={"type": int, "nargs": 2, "default": [504, 378], "metavar": ("W", "H"), "help": "multiples of 14"})
    if args.random is None and not args.checkpoint:
        raise SystemExit("give --checkpoint FILE, or --random SEED")
    width, height = args.size
    images = common.normalise(torch.cat(common.photo((width, height), args.views)), [0.485, 0.456, 0.406], [0.229, 0.224, 0.225])[None]
    with torch.no_grad():
        net = build(args, images)
        originals = {}
        for n in sorted({args.views, 1, 2}, reverse=True):
            said = net(images[:, :n])
            originals[n] = [said[name] for name in OUTPUTS]
        print("cameras:\n%s" % originals[args.views][2][0])
    weights = common.checkpoint(net)
    graph(args, Views(net, height, width).eval(), images, "image", OUTPUTS, originals)
    common.adapter(args, "da3", weights)


main()
