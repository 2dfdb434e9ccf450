#!/usr/bin/env python3
"""MASt3R → encoder.onnx, decoder.onnx, for one input size. Needs NAVER's mast3r and its dust3r on PYTHONPATH, torch, onnx,
onnxruntime, and a checkpoint from https://github.com/naver/mast3r (CC BY-NC-SA 4.0). No public package holds MASt3R, so this
script, unlike the others, is not run by tools/test-export; all but the class of the model is that of export_dust3r.py.

    python tools/export/export_mast3r.py --checkpoint MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth \\
        --out ~/.local/share/splatvk/models/mast3r
"""
import export_dust3r as dust3r
from mast3r.model import AsymmetricMASt3R


def main():
    args = dust3r.arguments(__doc__)
    if args.random is not None:
        raise SystemExit("--random: give --checkpoint FILE")
    dust3r.run(args, AsymmetricMASt3R.from_pretrained(args.checkpoint, landscape_only=False).eval(), "mast3r")


main()
