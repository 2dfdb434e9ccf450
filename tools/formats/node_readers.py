"""Checks of tools/formats/check with programs of npm: splat-transform, Spark and gltf-validator."""
import functools
import http.server
import json
import os
import shutil
import subprocess
import tempfile
import threading
import urllib.parse
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
HOME = HERE.parents[1] / ".deps/formats/node"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def check(c):
    """`c` is check.py: its work folder, readers, writers and comparisons."""
    if not (HOME / "node_modules").is_dir():
        return print("SKIPPED: no npm here, so splat-transform, Spark and gltf-validator did not read the files")
    for degree in range(4):
        splat_transform(c, degree)
    gltf_validator(c)
    browser = os.environ.get("CHROMIUM") or next(filter(shutil.which, BROWSERS), None)
    if browser is None:
        return print("SKIPPED: no Chromium here, so Spark did not read the files; name the program in CHROMIUM")
    spark(c, browser)


def few_rows(c, degree):
    """Splats with fifty different rows of SH: the palette of a .sog has room for them."""
    s = c.random_splats(900, degree, 20 + degree)
    return {**s, "shN": s["shN"][np.arange(900) % 50]}


# Parity of the SH basis in (x, z): what a turn by 180° about y changes, degrees 1 to 3.
ABOUT_Y = np.array([1, -1, -1, -1, -1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1])


def about_y(s):
    """The same splats turned by 180° about y."""
    w, x, y, z = s["quats"].T
    return {**s, "means": s["means"] * np.array([-1, 1, -1]), "quats": np.stack([-y, z, w, -x], 1),
            "shN": s["shN"] * ABOUT_Y[None, :s["shN"].shape[1], None]}


def convert(*args):
    done = subprocess.run([HOME / "node_modules/.bin/splat-transform", "-q", "-w", "-g", "cpu", *map(str, args)],
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=300)
    assert done.returncode == 0, done.stdout.decode()


def splat_transform(c, degree):
    s, source, back = few_rows(c, degree), c.WORK / "node.ply", c.WORK / "node-back.ply"
    c.write_ply(source, s)
    # A .sog has 16 bits of the logarithm of a position, 256 numbers for each quantity, 8 bits of a rotation component.
    sog = dict(means=8e-4, scales=0.03, rotation=5e-5, opacity=0.00197, sh0=0.012, sh=0.01)
    ours = {"sog": sog, "spz3": c.SPZ, "spz4": c.SPZ, "compressed.ply": c.packed_bounds(s)}
    for kind, bounds in ours.items():
        out = c.WORK / f"node-ours.{kind.rstrip('34')}"
        c.run("export", source, out, "--force", *(["--spz-version", kind[3:]] if "spz" in kind else []))
        convert(out, back)
        _, got = c.by_position(c.read_ply(back), s)
        c.compare(f"{kind} degree {degree}: splat-transform", got, s, **bounds)
    # It rounds down, spz has 12 fractional bits and SH of 5 and 4 bits, and its codebooks are its own.
    theirs = {
        "sog": dict(means=2e-3, scales=0.06, rotation=2e-4, opacity=0.004, sh0=0.03, sh=0.06),
        "spz": dict(means=2e-4, scales=0.0313, rotation=1e-5, opacity=0.00197, sh0=0.0131, sh=0.07),
        "glb": dict(means=1e-5, scales=1e-5, rotation=1e-6, opacity=1e-5, sh0=1e-6, sh=1e-5),
    }
    for kind, bounds in theirs.items():
        out = c.WORK / f"node-theirs.{kind}"
        convert(source, out)
        c.run("export", out, back, "--ply-degree", degree, "--force")
        # Both turn −y up to y up for glTF, splatvk about x and splat-transform about z.
        expected = about_y(s) if kind == "glb" else s
        _, got = c.by_position(c.read_ply(back), expected)
        c.compare(f"reading {kind} of splat-transform degree {degree}", got, expected, **bounds)


def gltf_validator(c):
    """No errors. Version 2.0.0-dev.3.10 does not know the extension, and so not the names of its attributes."""
    script = shutil.copy(HERE / "gltf_validator.mjs", HOME)
    for kind in ("glb", "gltf"):
        out = c.WORK / f"node-valid.{kind}"
        c.run("export", c.WORK / "in3.ply", out)
        issues = json.loads(subprocess.run(["node", script, out], check=True, stdout=subprocess.PIPE).stdout)
        unknown = lambda m: "/attributes/KHR_gaussian_splatting:" in m["pointer"] and m["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE"
        others = [m for m in issues["messages"] if m["code"] != "UNSUPPORTED_EXTENSION" and not unknown(m)]
        assert not others and not issues["truncated"], f"{kind}: {others}"
        print(f"ok  {kind}: gltf-validator, {issues['numWarnings']} warnings")


class Pages(http.server.SimpleHTTPRequestHandler):
    """The page, the packages and the files; keeps what the page tells."""

    def __init__(self, *args, work, told, **options):
        self.work, self.told = work, told
        super().__init__(*args, **options)

    def translate_path(self, path):
        path = urllib.parse.urlsplit(path).path
        if path == "/":
            return str(HERE / "spark.html")
        return str(self.work / Path(path).name if path.startswith("/work/") else HOME / path.lstrip("/"))

    def do_POST(self):
        self.told.append(json.loads(self.rfile.read(int(self.headers["content-length"]))))
        self.send_response(204)
        self.end_headers()

    def log_message(self, *args):
        pass


def spark(c, browser):
    """Spark holds positions as f16, scales on 254 steps of a logarithm, colours and opacities as bytes."""
    s, source = few_rows(c, 3), c.WORK / "node.ply"
    c.write_ply(source, s)
    told = []
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Pages, work=c.WORK, told=told))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    for kind, version in (("ply", None), ("compressed.ply", None), ("sog", None), ("splat", None), ("spz", 3), ("spz", 4)):
        out = c.WORK / f"node-spark.{kind}"
        c.run("export", source, out, "--force", *(["--spz-version", version] if version else []))
        told.clear()
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
            page = subprocess.Popen(
                [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}",
                 f"http://127.0.0.1:{server.server_port}/?file={out.name}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            for _ in range(600):
                if told or page.poll() is not None:
                    break
                threading.Event().wait(0.1)
            page.terminate()
            page.wait()
        assert told, f"{kind}: Spark told nothing within a minute"
        if version == 4:
            assert "error" in told[0], "Spark reads version 4 of .spz: correct the help of --spz-version and docs/use/formats.md"
            continue
        v = np.array(told[0].get("splats", told[0]))
        assert v.shape == (900, 14), told[0]
        # Spark takes the numbers of a file as they are: a .spz is right, up, back.
        expected = c.turned(s)["means"] if kind == "spz" else s["means"]
        rows = ((v[None, :, :3] - expected[:, None]) ** 2).sum(-1).argmin(1)
        v = v[rows]
        packed = c.packed_bounds(s) if kind == "compressed.ply" else dict(means=0, scales=0, sh0=0)
        c.close(f"Spark {kind} positions", v[:, :3], expected, 0.008 + packed["means"])
        c.close(f"Spark {kind} scales", np.log(v[:, 3:6]), s["scales"], 0.12 + packed["scales"])
        c.close(f"Spark {kind} opacity", v[:, 10], c.sigmoid(s["opacities"]), 0.007)
        c.close(f"Spark {kind} colours", v[:, 11:], 0.5 + c.C0 * s["sh0"], 0.012 + c.C0 * packed["sh0"])
        print(f"ok  {kind}: Spark")
    server.shutdown()
