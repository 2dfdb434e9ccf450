"""What every export script does: write the graph, its adapter and a reference, and compare ONNX Runtime with PyTorch.

    NAME.onnx              the graph, opset 17
    adapter.toml           family, checkpoint (hash of the weights), untrained = true for --random, sha256 of the files
    NAME.reference.npz     one input and PyTorch's answer, which `splatvk models check` repeats through its own loader
"""
import argparse
import hashlib
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch

OPSET = 17
TOLERANCE = 1e-3  # float32 sums in another order; the deepest network measured stays below a tenth of it


def arguments(text, **more):
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the model, for example ~/.local/share/splatvk/models/NAME")
    parser.add_argument("--random", type=int, metavar="SEED", help="untrained weights from this seed, for tests of everything but quality")
    for name, options in more.items():
        parser.add_argument("--" + name.replace("_", "-"), **options)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.random is not None:
        torch.manual_seed(args.random)
    return args


def checkpoint(*modules):
    """Identifies weights: graphs exported from the same ones belong together."""
    digest = hashlib.sha256()
    for module in modules:
        for name, value in sorted(module.state_dict().items()):
            digest.update(name.encode())
            digest.update(value.detach().cpu().contiguous().numpy().tobytes()[:4096])
    return digest.hexdigest()[:16]


def adapter(args, family, weights, text=""):
    lines = ['family = "%s"' % family, 'checkpoint = "%s"' % weights]
    if args.random is not None:
        lines.append("untrained = true")
    lines.append("[sha256]")
    for file in sorted(args.out.glob("*.onnx*")):
        with file.open("rb") as f:
            lines.append('"%s" = "%s"' % (file.name, hashlib.file_digest(f, "sha256").hexdigest()))
    (args.out / "adapter.toml").write_text("\n".join(lines) + "\n" + text)


def session(path):
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def graph(args, name, module, inputs, outputs, dynamic=None, reference=None):
    """Exports `module` called with the dict `inputs`, then runs both on `reference` (default: the same inputs)."""
    path = args.out / (name + ".onnx")
    module = module.eval()
    with torch.no_grad(), tempfile.TemporaryDirectory(dir=args.out) as folder:
        written = Path(folder) / path.name
        torch.onnx.export(module, tuple(inputs.values()), str(written), input_names=list(inputs), output_names=outputs,
                          dynamic_axes=dynamic or {}, opset_version=OPSET, do_constant_folding=True, dynamo=False)
        if len(list(Path(folder).iterdir())) == 1:
            written.replace(path)
        else:
            # Beyond protobuf's 2 GB the exporter writes a file per weight; one is easier to carry.
            beside = path.with_name(path.name + ".data")
            beside.unlink(missing_ok=True)
            onnx.save_model(onnx.load(written), path, save_as_external_data=True, location=beside.name)
            beside.chmod(path.stat().st_mode)
        inputs = reference or inputs
        began = time.time()
        wanted = module(*inputs.values())
        torch_seconds = time.time() - began
    wanted = [w.detach().numpy() for w in (wanted if isinstance(wanted, (tuple, list)) else [wanted])]
    fed = {k: v.numpy() for k, v in inputs.items()}
    running = session(path)
    began = time.time()
    given = running.run(outputs, {k: v for k, v in fed.items() if k in {i.name for i in running.get_inputs()}})
    seconds = time.time() - began
    worst = 0.0
    for output, a, b in zip(outputs, given, wanted):
        if a.shape != b.shape:
            sys.exit("%s: %s has shape %s in ONNX Runtime, %s in PyTorch" % (path, output, a.shape, b.shape))
        error = float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-12))
        worst = max(worst, error) if np.isfinite(error) else np.inf
        print("  %-24s %-22s relative error %.1e" % (output, list(b.shape), error))
    weights = sum(p.numel() for p in module.parameters()) / 1e6
    print("%s: %.1f M weights, ONNX Runtime %.2f s, PyTorch %.2f s, peak memory %.1f GB" % (
        path, weights, seconds, torch_seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6))
    if not worst < TOLERANCE:
        sys.exit("%s: ONNX Runtime and PyTorch differ by %.1e; the export is wrong" % (path, worst))
    arrays = {"in." + k: v for k, v in fed.items()}
    arrays.update({"out." + k: v for k, v in zip(outputs, wanted)})
    np.savez(args.out / (name + ".reference.npz"), **arrays)
    return wanted


def photo(size, count=2):
    """`count` of [1, 3, H, W] in [0, 1]: real photos of the repository's test scene, at most 4, stretched to (width, height); where
    the script stands alone, as `splatvk models fetch` runs it, waves of colour instead."""
    from PIL import Image
    folder = Path(__file__).resolve().parents[2] / "tests/data/breakfast/images"
    if not folder.is_dir():
        return [waves(size, 20.0 * k) for k in range(count)]
    return [torch.from_numpy(np.asarray(Image.open(p).convert("RGB").resize(size, Image.BICUBIC)).astype(np.float32) / 255)
            .permute(2, 0, 1)[None].contiguous() for p in sorted(folder.iterdir())[:count]]


def waves(size, shift):
    """The texture of crates/splatvk-infer/src/check.rs: smooth, and nowhere the same."""
    x, y = np.meshgrid(np.arange(size[0]) + shift, np.arange(size[1]))
    rows = [0.5 + 0.5 * np.sin(x * a + 1) * np.cos(y * b - 1) for a, b in [(0.11, 0.07), (0.05, 0.13), (0.23, 0.19)]]
    return torch.from_numpy(np.stack(rows)[None].astype(np.float32))


def normalise(image, mean, std):
    return (image - torch.tensor(mean).view(1, 3, 1, 1)) / torch.tensor(std).view(1, 3, 1, 1)
