#!/usr/bin/env python3
"""SAM 2.1 for single images → encoder.onnx, decoder.onnx (any number of prompts a call). Needs: pip install torch torchvision
onnx onnxruntime sam2, and a checkpoint from https://github.com/facebookresearch/sam2

    python tools/export/export_sam2.py --model large --checkpoint sam2.1_hiera_large.pt --out ~/.local/share/splatvk/models/sam2
"""
import torch
from sam2.build_sam import build_sam2
from sam2.sam2_image_predictor import SAM2ImagePredictor

import common
import export_sam

CONFIGURATIONS = {"tiny": "t", "small": "s", "base_plus": "b+", "large": "l"}
SIZE = (1024, 768)


class Encoder(torch.nn.Module):
    """What SAM2ImagePredictor.set_image keeps of an image. The memory of videos is left out, but for the vector that stands for
    an empty one."""

    def __init__(self, sam):
        super().__init__()
        self.encoder, self.no_memory = sam.image_encoder, sam.no_mem_embed
        self.conv_s0, self.conv_s1 = sam.sam_mask_decoder.conv_s0, sam.sam_mask_decoder.conv_s1
        # A constant, because torch exports Tensor.tile as branches that ONNX Runtime 1.24 optimises into wrong values.
        trunk, side = sam.image_encoder.trunk, sam.image_size // 4
        with torch.no_grad():
            table = trunk._get_pos_embed((side, side))
        trunk._get_pos_embed = lambda _: table

    def forward(self, image):
        fine, middle, coarse = self.encoder(image)["backbone_fpn"]
        return coarse + self.no_memory.reshape(1, -1, 1, 1), self.conv_s0(fine), self.conv_s1(middle)


class Decoder(export_sam.Decoder):
    """With the finer features added on the way up. It appends the padding point itself, as the built-in adapter expects of SAM 2
    decoders."""

    def forward(self, image_embed, high_res_feats_0, high_res_feats_1, point_coords, point_labels):
        d, sparse = self.decoder, self.points(point_coords, point_labels)
        padding = self.prompt.not_a_point_embed.weight.unsqueeze(0).expand(sparse.shape[0], -1, -1)
        up_1, norm, gelu_1, up_0, gelu_0 = d.output_upscaling
        upscale = lambda x: gelu_0(up_0(gelu_1(norm(up_1(x) + high_res_feats_1))) + high_res_feats_0)
        first = [d.obj_score_token.weight] if d.pred_obj_scores else []
        return self.masks(image_embed, torch.cat([sparse, padding], dim=1), upscale, first)


def untrained(sam):
    with torch.no_grad():
        trunk = sam.image_encoder.trunk
        for p in trunk.parameters():
            if not p.abs().any():
                p.normal_(std=0.02)  # what starts at zero would prove nothing
        trunk.pos_embed.normal_(std=0.3)
        trunk.pos_embed_window.normal_(std=0.3)
        sam.no_mem_embed.normal_(std=0.3)
        # As in export_sam.py: predicted IoU over its threshold (before the sigmoid), logits spread as far as trained ones.
        head = sam.sam_mask_decoder.iou_prediction_head.layers[-1]
        head.weight.mul_(8)
        head.bias.fill_(3)
        for mlp in sam.sam_mask_decoder.output_hypernetworks_mlps:
            mlp.layers[-1].weight.mul_(480)
            mlp.layers[-1].bias.mul_(8)


def differ(name, ours, theirs):
    error = float(abs(ours - theirs.numpy()).max() / abs(theirs.numpy()).max())
    print("  %-24s against the package: %.1e" % (name, error))
    assert error < 1e-4, "%s differs from the package by %g" % (name, error)


def main():
    args = common.arguments(__doc__, model={"default": "base_plus", "choices": list(CONFIGURATIONS)}, checkpoint={})
    if args.random is None and not args.checkpoint:
        raise SystemExit("give --checkpoint FILE, or --random SEED")
    configuration = "configs/sam2.1/sam2.1_hiera_%s.yaml" % CONFIGURATIONS[args.model]
    sam = build_sam2(configuration, None if args.random is not None else args.checkpoint, device="cpu", apply_postprocessing=False)
    if args.random is not None:
        untrained(sam)
    # The package's own path from the photo to the features, and its input for ours.
    photo = common.photo(SIZE)[0][0].permute(1, 2, 0).mul(255).round().byte().numpy()
    predictor = SAM2ImagePredictor(sam)
    predictor.set_image(photo)
    encoder, decoder = Encoder(sam), Decoder(sam.sam_prompt_encoder, sam.sam_mask_decoder)
    weights = common.checkpoint(decoder)
    used = {id(p): p.numel() for m in (encoder, decoder) for p in m.parameters()}
    print("SAM 2.1 %s: %d weights for images" % (args.model, sum(used.values())))
    names = ["image_embed", "high_res_feats_0", "high_res_feats_1"]
    features = common.graph(args, "encoder", encoder, {"image": predictor._transforms(photo)[None]}, names)
    official = [predictor._features["image_embed"], *predictor._features["high_res_feats"]]
    for name, ours, theirs in zip(names, features, official):
        differ(name, ours, theirs)

    inputs = lambda n: {
        **{name: torch.from_numpy(f) for name, f in zip(names, features)},
        "point_coords": torch.rand(n, 1, 2) * 1024,
        "point_labels": torch.ones(n, 1),
    }
    reference, outputs = inputs(5), ["low_res_masks", "iou_predictions"]
    dynamic = {0: "prompts", 1: "points"}
    masks, scores = common.graph(args, "decoder", decoder, inputs(3), outputs, {
        "point_coords": dynamic, "point_labels": dynamic, "low_res_masks": {0: "prompts"}, "iou_predictions": {0: "prompts"},
    }, reference)
    coords, labels = reference["point_coords"], reference["point_labels"]
    with torch.no_grad():
        sparse, dense = sam.sam_prompt_encoder(points=(coords, labels.int()), boxes=None, masks=None)
        all_masks, all_scores, _, _ = sam.sam_mask_decoder.predict_masks(
            image_embeddings=reference["image_embed"], image_pe=sam.sam_prompt_encoder.get_dense_pe(), sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense, repeat_image=True, high_res_features=[reference[n] for n in names[1:]])
    differ("low_res_masks", masks, all_masks)
    differ("iou_predictions", scores, all_scores)
    # One prompt in pixels of the photo: the last three masks, which the predictor clips.
    point = coords[:1, 0].numpy() * SIZE / 1024
    _, three_scores, three = predictor.predict(point, labels[0].numpy(), multimask_output=True)
    differ("predictor, masks", masks[0, 1:].clip(-32, 32), torch.from_numpy(three))
    differ("predictor, scores", scores[0, 1:], torch.from_numpy(three_scores))
    common.adapter(args, "sam2", weights)


main()
