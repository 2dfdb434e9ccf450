"""Gathers the site's pages in target/site-sources: those of docs, and references made from what they describe. MkDocs runs it as a
hook, see docs/mkdocs.yml. The program named by SPLATVK, or else target/release/splatvk, gives the help of its commands."""
import html, json, os, posixpath, re, shutil, subprocess
from pathlib import Path

import latex2mathml.converter

import c_header, python_stub, schema_pages

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "target/site-sources"
REPOSITORY = "https://github.com/splatvk/splatvk/blob/main/"
# Folders and files of the repository, and their place in the site; the first match counts.
PLACES = [
    ("README.md", "index.md"),
    ("docs/use/schemas/README.md", "schemas/index.md"),
    ("docs/use/", ""),
    ("docs/internals/", "internals/"),
    ("docs/log/", "log/"),
    ("docs/images/", "images/"),
    ("tools/export/README.md", "internals/export.md"),
    ("include/splatvk.h", "c-api.md"),
    ("CONTRIBUTING.md", "project/contributing.md"),
    ("SECURITY.md", "project/security.md"),
    ("CHANGELOG.md", "project/changelog.md"),
    ("THIRD_PARTY.md", "project/third_party.md"),
]
# Pages of the navigation that may be absent.
OPTIONAL = {"install.md", "cluster.md"}
# Pages that are made here, in their order.
generated = []
LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?(\))")


def on_config(config):
    gather()
    config.nav = [entry for entry in (expanded(entry) for entry in config.nav) if entry is not None]
    return config


def on_page_content(content, **_):
    """The HTML of a page with its formulas as MathML."""
    formula = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.S)
    display = {"span": "inline", "div": "block"}
    return formula.sub(lambda m: latex2mathml.converter.convert(html.unescape(m[2]), display=display[m[1]]), content)


def expanded(entry):
    """An entry of the navigation with `folder/*` replaced by the pages of the folder, and absent optional pages left out."""
    if isinstance(entry, str):
        return entry
    [(title, inside)] = entry.items()
    if isinstance(inside, str):
        return None if inside in OPTIONAL and not (OUT / inside).exists() else entry
    all = []
    for one in inside:
        if isinstance(one, str) and one.endswith("/*"):
            all += [page for page in generated if page.startswith(one[:-1])]
        elif (one := expanded(one)) is not None:
            all.append(one)
    return {title: all}


def gather():
    generated.clear()
    shutil.rmtree(OUT, ignore_errors=True)
    for source, _ in PLACES:
        here = ROOT / source
        for file in sorted(here.rglob("*")) if here.is_dir() else [here]:
            if file.suffix in {".md", ".jpg", ".png"}:
                copy(file.relative_to(ROOT).as_posix())
    for name in ("style.css", "iframe-worker.js"):
        write(f"assets/{name}", (ROOT / "docs/site" / name).read_text())
    commands()
    write("c-api.md", c_header.page((ROOT / "include/splatvk.h").read_text()))
    for name, text in schema_pages.pages(ROOT / "docs/use/schemas"):
        write(f"schemas/{name}.md", text)
    python_stub.write(ROOT / "bindings/python", ROOT / "target/site-python")
    write("python-api.md", python_stub.page())


def write(path, text):
    (OUT / path).parent.mkdir(parents=True, exist_ok=True)
    (OUT / path).write_text(text)
    generated.append(path)


def place(source):
    """Place in the site of a file of the repository; None where the site does not have it."""
    for start, to in PLACES:
        if source == start or (start.endswith("/") and source.startswith(start)):
            return to + source[len(start):]
    return None


def copy(source):
    to = place(source)
    if not source.endswith(".md"):
        (OUT / to).parent.mkdir(parents=True, exist_ok=True)
        return shutil.copyfile(ROOT / source, OUT / to)
    text = "".join(block if at % 2 else linked(block, source, to) for at, block in enumerate(fences((ROOT / source).read_text())))
    if to.startswith("log/"):
        text = "---\nsearch:\n  exclude: true\n---\n" + text
    (OUT / to).parent.mkdir(parents=True, exist_ok=True)
    (OUT / to).write_text(text)


def fences(text):
    """Prose and fenced blocks of a page in turns."""
    return re.split(r"(^```.*?^```$)", text, flags=re.M | re.S)


def linked(text, source, page):
    """A piece of a page with its links as the site has them."""

    def one(match):
        before, target, anchor, after = match.groups()
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if not (ROOT / path).exists():
            return match[0]  # MkDocs reports it.
        schema = re.fullmatch(r"docs/use/schemas/(?:examples/)?([\w-]+?)(?:\.schema)?\.jsonl?", path)
        to = f"schemas/{schema[1]}.md" if schema else place(path)
        if to is None or not to.endswith((".md", ".jpg", ".png")):
            return before + REPOSITORY + path + (anchor or "") + after
        return before + posixpath.relpath(to, posixpath.dirname(page) or ".") + (anchor or "") + after

    return LINK.sub(one, text)


# Commands: `splatvk COMMAND --help` has sections of indented items, each with an indented text.


def helped(*words):
    program = os.environ.get("SPLATVK") or ROOT / "target/release/splatvk"
    try:
        done = subprocess.run([program, *words, "--help"], capture_output=True, text=True, check=True)
    except FileNotFoundError:
        raise SystemExit(f"{program} is missing: cargo build --release, or name the program in SPLATVK")
    return re.sub(r"[ \t]+$", "", done.stdout, flags=re.M)


def subcommands(text):
    listed = re.search(r"^Commands:\n((?:  .*\n)+)", text, re.M)
    return [line.split()[0] for line in listed[1].splitlines() if line.split()[0] != "help"] if listed else []


def commands():
    for name in subcommands(helped()):
        text = helped(name)
        parts = [f"# splatvk {name}\n\n" + described(text)]
        for sub in subcommands(text):
            parts.append(f"## splatvk {name} {sub}\n\n" + described(helped(name, sub), "###"))
        write(f"commands/{name}.md", "\n".join(parts))


def described(text, level="##"):
    """The help of a command as Markdown."""
    about, usage, rest = re.fullmatch(r"(.*?)\n\nUsage: (.*?)\n\n(.*)", text, re.S).groups()
    out = [about, "", "```text", usage, "```", ""]
    for section in re.split(r"\n\n(?=\S)", rest.strip("\n")):
        title, _, body = section.partition(":\n")
        items = re.split(r"\n+(?= {2,6}\S)", "\n" + body)[1:]
        if title == "Commands":
            continue  # Each has a section.
        out += [f"{level} {title}", "", '<dl class="options">']
        for item in items:
            head, _, meaning = item.strip().partition("\n")
            out.append(f"<dt><code>{html.escape(head)}</code></dt><dd>{prose(meaning)}</dd>")
        out += ["</dl>", ""]
    return "\n".join(out)


def prose(meaning):
    """The text of an option: paragraphs, and a list of its values."""
    lines = [html.escape(line.strip()) for line in meaning.splitlines() if line.strip()]
    lines = [re.sub(r"`([^`]*)`", r"<code>\1</code>", line) for line in lines]
    out, values = [], []
    for line in lines:
        if line.startswith("- "):
            name, _, what = line[2:].partition(":")
            values.append(f"<li><code>{name}</code>: {what.strip()}</li>")
        elif line != "Possible values:":
            line = re.sub(r"\[(default|possible values): ([^\]]*)\]$", r'<span class="default">[\1: \2]</span>', line)
            out.append(f"<p>{line}</p>")
    return "".join(out[:1] + ([f"<ul>{''.join(values)}</ul>"] if values else []) + out[1:])
