"""Adds to a CycloneDX list of crates what else a package holds: ONNX Runtime, models, Debian's packages.

    sbom.py CRATES.json OUT.json [--packages DPKG.tsv] [--only-models]

The models stand in crates/splatvk-infer/src/pack.json. --packages takes lines `name<TAB>version<TAB>architecture`.
"""

import argparse
import json
import platform
from pathlib import Path

PACK = Path(__file__).parents[2] / "crates/splatvk-infer/src/pack.json"


def component(kind, name, version, licence=None, sha256=None, purl=None):
    """One entry; absent values are left out, as the schema wants it."""
    entry = {"type": kind, "name": name, "version": version}
    if licence:
        entry["licenses"] = [{"expression": licence}]
    if sha256:
        entry["hashes"] = [{"alg": "SHA-256", "content": sha256}]
    if purl:
        entry["purl"] = purl
        entry["bom-ref"] = purl
    return entry


def models(pack):
    """The files of the pack, each from a package of PyPI."""
    for file in pack["files"]:
        source = pack["packages"][file["package"]]
        kind = "data" if file["file"].endswith(".tsv") else "machine-learning-model"
        yield component(kind, file["name"], source["version"], source["licence"], file["sha256"],
                        f"pkg:pypi/{file['package']}@{source['version']}#{file['file']}")


def runtime(pack):
    """ONNX Runtime. Its hash is that of the file before symbols are stripped."""
    name, source = pack["runtime"]["package"], pack["packages"][pack["runtime"]["package"]]
    yield component("library", name, source["version"], source["licence"],
                    pack["runtime"]["sha256"].get(platform.machine()), f"pkg:pypi/{name}@{source['version']}")


def debian(path):
    """Packages of the base system."""
    for line in path.read_text().splitlines():
        name, version, architecture = line.split("\t")
        yield component("library", name, version, purl=f"pkg:deb/debian/{name}@{version}?arch={architecture}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("crates", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--packages", type=Path)
    parser.add_argument("--only-models", action="store_true", help="leave the crates and ONNX Runtime out")
    args = parser.parse_args()
    bom, pack = json.loads(args.crates.read_text()), json.loads(PACK.read_text())
    if args.only_models:
        bom["metadata"]["component"] = component("data", "splatvk-models", bom["metadata"]["component"]["version"])
        bom.update(components=[], dependencies=[])
    else:
        bom["components"] += runtime(pack)
    bom["components"] += models(pack)
    if args.packages:
        bom["components"] += debian(args.packages)
    args.out.write_text(json.dumps(bom, indent=1) + "\n")


main()
