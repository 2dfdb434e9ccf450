"""A notebook in a real browser: the view of a scene draws, answers, and its selection comes back.

    python notebook_in_browser.py SCENE [FOLDER FOR SCREENSHOTS]

Needs the packages splatvk[notebook], notebook and playwright, and Chromium (CHROMIUM names it).
Not part of pytest: a server, a kernel and a browser take minutes on two cores.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

CELLS = [
    "import splatvk\nscene = splatvk.load({scene!r})\nscene",
    "view = scene.widget(height=420)\nview",
    "print('selected', int(view.mask.sum()), view.text)",
]
SECONDS = 240


def notebook(scene):
    cells = [
        {
            "cell_type": "code",
            "id": f"cell{i}",
            "execution_count": None,
            "metadata": {"trusted": True},
            "outputs": [],
            "source": source.replace("{scene!r}", repr(str(scene))),
        }
        for i, source in enumerate(CELLS)
    ]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}


def server(folder):
    """A notebook server on loopback, and its address."""
    command = [sys.executable, "-m", "jupyter", "notebook", "--no-browser", "--allow-root"]
    command += ["--ip=127.0.0.1", "--port=0", "--IdentityProvider.token=", f"--notebook-dir={folder}"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    for line in process.stderr:
        found = re.search(r"http://127\.0\.0\.1:\d+", line)
        if found:
            # The pipe must not fill up.
            subprocess.Popen(["cat"], stdin=process.stderr, stdout=subprocess.DEVNULL)
            return process, found.group()
    raise SystemExit("the notebook server did not start")


def run_cell(page, index):
    page.locator(".jp-CodeCell").nth(index).locator(".cm-content").click()
    page.keyboard.press("Shift+Enter")


def view(page, index):
    """The frame of an output, once its scene is drawn."""
    frame = page.locator(".jp-CodeCell").nth(index).locator("iframe").first
    frame.wait_for(timeout=SECONDS * 1000)
    frame.scroll_into_view_if_needed()
    inside = frame.element_handle().content_frame()
    inside.wait_for_function("window.splatvk", timeout=SECONDS * 1000)
    inside.evaluate("splatvk.ready")
    inside.evaluate("splatvk.settled()")
    return inside


def check(page, shots):
    run_cell(page, 0)
    view(page, 0)
    page.screenshot(path=shots / "scene.png")
    run_cell(page, 1)
    inside = view(page, 1)
    inside.evaluate("splatvk.ask('lemon')")
    card = inside.evaluate("document.querySelector('.v-card').innerText")
    assert "lemon" in card and ("Found" in card or "Unsure" in card), card
    page.screenshot(path=shots / "widget.png")
    run_cell(page, 2)
    output = page.locator(".jp-CodeCell").nth(2).locator(".jp-OutputArea-output pre").first
    output.wait_for(timeout=SECONDS * 1000)
    text = output.inner_text()
    print(text)
    count = int(re.match(r"selected (\d+) lemon", text).group(1))
    assert count > 0, text


def main(scene, shots):
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "scene.ipynb").write_text(json.dumps(notebook(Path(scene).resolve())))
        process, address = server(folder)
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        try:
            with sync_playwright() as tools:
                browser = tools.chromium.launch(executable_path=chromium, args=flags)
                page = browser.new_page(viewport={"width": 1100, "height": 900})
                page.set_default_timeout(SECONDS * 1000)
                page.goto(f"{address}/notebooks/scene.ipynb")
                page.locator(".jp-CodeCell").first.wait_for()
                check(page, shots)
                browser.close()
        finally:
            process.terminate()
            process.wait(20)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    main(sys.argv[1], Path(sys.argv[2] if len(sys.argv) > 2 else tempfile.mkdtemp()))
