#!/usr/bin/env python3
"""MobileSAM → encoder.onnx (TinyViT), decoder.onnx (SAM's own, any number of prompts a call). Needs: pip install torch torchvision
timm onnx onnxruntime mobilesam-mirror, and mobile_sam.pt from https://github.com/ChaoningZhang/MobileSAM

    python tools/export/export_mobile_sam.py --checkpoint mobile_sam.pt --out ~/.local/share/splatvk/models/mobile_sam
"""
import mobile_sam
import torch

import common
import export_sam


def untrained(sam):
    export_sam.untrained(sam)
    with torch.no_grad():
        # As after training: what starts at zero, or so small that nearly nothing passes, would hide mistakes behind it.
        for name, p in sam.image_encoder.named_parameters():
            if name.endswith("attention_biases"):
                p.normal_(std=0.5)
        for m in sam.image_encoder.modules():
            if isinstance(m, torch.nn.Linear):
                m.weight.mul_(3)
            if isinstance(m, torch.nn.BatchNorm2d):
                m.weight.uniform_(0.5, 1.5)
                m.running_mean.normal_(std=0.1)
                m.running_var.uniform_(0.8, 1.2)


def main():
    args = common.arguments(__doc__, checkpoint={})
    if args.random is None and not args.checkpoint:
        raise SystemExit("give --checkpoint FILE, or --random SEED")
    sam = mobile_sam.sam_model_registry["vit_t"](checkpoint=None if args.random is not None else args.checkpoint)
    if args.random is not None:
        untrained(sam)
    # The classifier of the TinyViT is never used.
    del sam.image_encoder.norm_head, sam.image_encoder.head
    # The table of attention biases is made by eval(), which the package calls before it loads the weights.
    sam.eval()
    print("MobileSAM: %d weights" % sum(p.numel() for p in sam.parameters()))
    export_sam.export(args, sam)


main()
