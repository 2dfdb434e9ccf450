#!/usr/bin/env python3
"""Segment Anything → encoder.onnx, decoder.onnx (any number of prompts a call). Needs: pip install torch torchvision onnx
onnxruntime segment-anything, and a checkpoint from https://github.com/facebookresearch/segment-anything

    python tools/export/export_sam.py --model vit_b --checkpoint sam_vit_b_01ec64.pth --out ~/.local/share/splatvk/models/sam_vit_b
"""
import torch

import common


class Attention(torch.nn.Module):
    """Attention over the whole picture, head by head: the 4096 × 4096 weights of all heads at once take 800 MB, several times over."""

    def __init__(self, original):
        super().__init__()
        self.original = original

    def forward(self, x):
        o, (b, rows, columns, c) = self.original, x.shape
        q, k, v = o.qkv(x).reshape(b, rows * columns, 3, o.num_heads, c // o.num_heads).permute(2, 3, 0, 1, 4)
        # [place, channel, other place]: what a query says to a key that is so many rows or columns away
        away = lambda n, table: table[torch.arange(n)[:, None] - torch.arange(n) + n - 1].transpose(1, 2)
        by_row, by_column = away(rows, o.rel_pos_h), away(columns, o.rel_pos_w)
        heads = []
        for h in range(o.num_heads):
            at = q[h].reshape(b, rows, columns, -1)
            down = (at @ by_row)[..., None]
            across = (at.transpose(1, 2) @ by_column).transpose(1, 2)[..., None, :]
            weights = (o.scale * q[h] @ k[h].transpose(1, 2)).reshape(b, rows, columns, rows, columns) + down + across
            heads.append(weights.reshape(b, rows * columns, -1).softmax(dim=-1) @ v[h])
        return o.proj(torch.cat(heads, dim=-1).reshape(b, rows, columns, c))


class Decoder(torch.nn.Module):
    """Points in, low-resolution logits and predicted IoU out, one row per prompt: splatvk upsamples by itself, so that no
    full-size mask ever leaves the graph."""

    def __init__(self, prompt, decoder):
        super().__init__()
        self.prompt, self.decoder = prompt, decoder
        self.register_buffer("position", prompt.get_dense_pe())

    def points(self, coords, labels):
        encoder = self.prompt
        at = encoder.pe_layer._pe_encoding((coords + 0.5) / float(encoder.input_image_size[0]))
        labels = labels.unsqueeze(-1)
        at = at * (labels != -1).to(at.dtype) + encoder.not_a_point_embed.weight * (labels == -1).to(at.dtype)
        for k, embedding in enumerate(encoder.point_embeddings):
            at = at + embedding.weight * (labels == k).to(at.dtype)
        return at

    def masks(self, image, sparse, upscale, first=()):
        """`first`: tokens before those of masks; `upscale`: [prompts, C, h, w] → [prompts, C / 8, 4 h, 4 w]"""
        d, prompts = self.decoder, sparse.shape[0]
        out = torch.cat([*first, d.iou_token.weight, d.mask_tokens.weight], dim=0)
        tokens = torch.cat([out.unsqueeze(0).expand(prompts, -1, -1), sparse], dim=1)
        source = image + self.prompt.no_mask_embed.weight.reshape(1, -1, 1, 1)
        source = source.expand(prompts, -1, -1, -1)
        hidden, source_out = d.transformer(source, self.position.expand(prompts, -1, -1, -1), tokens)
        hidden = hidden[:, len(first):]
        _, c, h, w = image.shape
        up = upscale(source_out.transpose(1, 2).reshape(prompts, c, h, w))
        weights = torch.stack([m(hidden[:, 1 + k]) for k, m in enumerate(d.output_hypernetworks_mlps)], dim=1)
        masks = (weights @ up.flatten(2)).reshape(prompts, -1, 4 * h, 4 * w)
        return masks, d.iou_prediction_head(hidden[:, 0])

    def forward(self, image_embeddings, point_coords, point_labels):
        return self.masks(image_embeddings, self.points(point_coords, point_labels), self.decoder.output_upscaling)


def untrained(sam):
    with torch.no_grad():
        # Untrained, hardly any mask would pass the filters and what follows would have nothing to do: the predicted
        # IoU is lifted over its threshold and logits spread as far as trained ones, so that the work is the real one.
        sam.mask_decoder.iou_prediction_head.layers[-1].bias.fill_(0.9)
        for mlp in sam.mask_decoder.output_hypernetworks_mlps:
            mlp.layers[-1].weight.mul_(480)
            mlp.layers[-1].bias.mul_(8)
        for p in sam.image_encoder.parameters():
            if not p.abs().any():
                p.normal_(std=0.02)  # position tables start at zero, which would prove nothing


def export(args, sam):
    """Writes both graphs of `sam`, a segment_anything Sam or one of a package that copies it."""
    weights = common.checkpoint(sam.mask_decoder, sam.prompt_encoder)
    image = common.photo((1024, 768))[0]
    image = common.normalise(image, [0.485, 0.456, 0.406], [0.229, 0.224, 0.225])
    image = torch.nn.functional.pad(image, (0, 0, 0, 256))
    with torch.no_grad():
        wanted = sam.image_encoder(image).numpy()
    for block in getattr(sam.image_encoder, "blocks", []):
        if block.window_size == 0:
            block.attn = Attention(block.attn)
    embedding = common.graph(args, "encoder", sam.image_encoder, {"image": image}, ["image_embeddings"])[0]
    error = abs(embedding - wanted).max() / abs(wanted).max()
    assert error < 1e-4, "image_embeddings differ from the official encoder by %g" % error
    inputs = lambda n: {
        "image_embeddings": torch.from_numpy(embedding),
        "point_coords": torch.cat([torch.rand(n, 1, 2) * torch.tensor([1024.0, 768.0]), torch.zeros(n, 1, 2)], dim=1),
        "point_labels": torch.tensor([[1.0, -1.0]]).repeat(n, 1),
    }
    reference, outputs = inputs(5), ["low_res_masks", "iou_predictions"]
    masks, scores = common.graph(args, "decoder", Decoder(sam.prompt_encoder, sam.mask_decoder), inputs(3), outputs, {
        "point_coords": {0: "prompts"}, "point_labels": {0: "prompts"}, "low_res_masks": {0: "prompts"}, "iou_predictions": {0: "prompts"},
    }, reference)
    with torch.no_grad():
        lone = reference["point_coords"][:, :1], reference["point_labels"][:, :1]
        sparse, dense = sam.prompt_encoder(points=lone, boxes=None, masks=None)
        official = sam.mask_decoder.predict_masks(
            image_embeddings=reference["image_embeddings"], image_pe=sam.prompt_encoder.get_dense_pe(),
            sparse_prompt_embeddings=sparse, dense_prompt_embeddings=dense)
    for name, a, b in zip(outputs, (masks, scores), official):
        error = abs(a - b.numpy()).max() / abs(b.numpy()).max()
        assert error < 1e-4, "%s differs from the official decoder by %g" % (name, error)
    common.adapter(args, "sam", weights)


def main():
    import segment_anything  # not above: export_mobile_sam.py does without it
    args = common.arguments(__doc__, model={"default": "vit_b", "choices": ["vit_b", "vit_l", "vit_h"]}, checkpoint={})
    if args.random is None and not args.checkpoint:
        raise SystemExit("give --checkpoint FILE, or --random SEED")
    sam = segment_anything.sam_model_registry[args.model](checkpoint=None if args.random is not None else args.checkpoint).eval()
    if args.random is not None:
        untrained(sam)
    print("SAM %s: %d weights" % (args.model, sum(p.numel() for p in sam.parameters())))
    export(args, sam)


if __name__ == "__main__":
    main()
