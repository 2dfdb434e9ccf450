#!/usr/bin/env python3
"""OpenCLIP → image.onnx, text.onnx, tokenizer.json. Needs: pip install torch onnx onnxruntime open-clip-torch

    python tools/export/export_clip.py --out ~/.local/share/splatvk/models/clip_vit_b16
"""
import gzip
import json
import re
from pathlib import Path

import open_clip
import torch

import common


class Image(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.visual = model.visual

    def forward(self, pixel_values):
        return torch.nn.functional.normalize(self.visual(pixel_values), dim=-1)


class Text(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        names = ["transformer", "token_embedding", "ln_final"]
        for name in names:
            setattr(self, name, getattr(model, name))
        self.positional_embedding, self.text_projection = model.positional_embedding, model.text_projection
        self.register_buffer("attn_mask", model.attn_mask)

    def forward(self, input_ids):
        x = self.token_embedding(input_ids) + self.positional_embedding
        x = self.ln_final(self.transformer(x, attn_mask=self.attn_mask))
        # The end mark has the largest id; as a weighted sum instead of an index, which exports with any batch.
        end = (input_ids == input_ids.max(dim=-1, keepdim=True).values).to(x.dtype)
        first = end * (torch.cumsum(end, dim=-1) == 1).to(x.dtype)
        x = (x * first.unsqueeze(-1)).sum(dim=1) @ self.text_projection
        return torch.nn.functional.normalize(x, dim=-1)


def tokenizer(path):
    """The byte-pair vocabulary that open_clip ships, in the format of the Rust crate `tokenizers`."""
    source = Path(open_clip.__file__).parent / "bpe_simple_vocab_16e6.txt.gz"
    merges = gzip.open(source).read().decode("utf-8").split("\n")[1:49152 - 256 - 2 + 1]
    kept = list(range(ord("!"), ord("~") + 1)) + list(range(ord("¡"), ord("¬") + 1)) + list(range(ord("®"), ord("ÿ") + 1))
    alphabet = [chr(b) for b in kept] + [chr(256 + n) for n in range(256 - len(kept))]
    pairs = [m.split() for m in merges]
    words = alphabet + [a + "</w>" for a in alphabet] + ["".join(p) for p in pairs] + ["<|startoftext|>", "<|endoftext|>"]
    vocabulary = {w: i for i, w in enumerate(words)}
    start, end = vocabulary["<|startoftext|>"], vocabulary["<|endoftext|>"]
    pattern = r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"
    special = lambda word, i: {"id": i, "content": word, "single_word": False, "lstrip": False, "rstrip": False, "normalized": False, "special": True}
    json.dump({
        "version": "1.0", "truncation": None, "padding": None,
        "added_tokens": [special("<|startoftext|>", start), special("<|endoftext|>", end)],
        "normalizer": {"type": "Sequence", "normalizers": [
            {"type": "NFC"}, {"type": "Replace", "pattern": {"Regex": r"\s+"}, "content": " "}, {"type": "Lowercase"}]},
        "pre_tokenizer": {"type": "Sequence", "pretokenizers": [
            {"type": "Split", "pattern": {"Regex": pattern}, "behavior": "Removed", "invert": True},
            {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": False}]},
        "post_processor": {"type": "RobertaProcessing", "sep": ["<|endoftext|>", end], "cls": ["<|startoftext|>", start],
                           "trim_offsets": False, "add_prefix_space": False},
        "decoder": {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": False},
        "model": {"type": "BPE", "dropout": None, "unk_token": "<|endoftext|>", "continuing_subword_prefix": "",
                  "end_of_word_suffix": "</w>", "fuse_unk": False, "vocab": vocabulary, "merges": [" ".join(p) for p in pairs]},
    }, path.open("w"), ensure_ascii=False)


def main():
    args = common.arguments(__doc__, model={"default": "ViT-B-16"}, pretrained={"default": "laion2b_s34b_b88k"})
    torch.backends.mha.set_fastpath_enabled(False)  # its fused kernels have no ONNX form
    model = open_clip.create_model(args.model, pretrained=None if args.random is not None else args.pretrained).eval()
    weights = common.checkpoint(model)
    size = model.visual.image_size
    size = size[0] if isinstance(size, (tuple, list)) else size
    images = [common.normalise(p, open_clip.OPENAI_DATASET_MEAN, open_clip.OPENAI_DATASET_STD) for p in common.photo((size, size))]
    tokens = open_clip.get_tokenizer(args.model)(["a blue mug", "object"])
    print("%s: %d weights" % (args.model, sum(p.numel() for p in model.parameters())))
    batch = lambda *names: {n: {0: "batch"} for n in names}
    common.graph(args, "image", Image(model), {"pixel_values": images[0]}, ["image_embeds"],
                 batch("pixel_values", "image_embeds"), {"pixel_values": torch.cat(images)})
    text = common.graph(args, "text", Text(model), {"input_ids": tokens}, ["text_embeds"], batch("input_ids", "text_embeds"))[0]
    with torch.no_grad():
        same = torch.nn.functional.normalize(model.encode_text(tokens), dim=-1).numpy()
    assert abs(text - same).max() < 1e-5, "the text tower does not do what open_clip does"
    tokenizer(args.out / "tokenizer.json")
    common.adapter(args, "clip", weights)


main()
