"""The reference of the C interface: declarations of include/splatvk.h with their comments as text."""
import re

COMMENT = re.compile(r"/\*(.*?)\*/", re.S)
KINDS = {"fn": "Functions", "struct": "Structures", "enum": "Enumerations", "other": "Handles, callbacks and constants"}


def words(comment):
    """A comment as Markdown: paragraphs and lists."""
    lines = [re.sub(r"^\s*\* ?", "", line).strip() if line.strip().startswith("*") else line.strip() for line in comment.splitlines()]
    # Brackets are dimensions of arrays, no links.
    text = "\n".join(lines).strip().replace("[", "\\[")
    # A list needs a blank line before it.
    return re.sub(r"(?<=[^\n])\n(- )", r"\n\n\1", text, count=1)


def fields(body):
    """(declaration, meaning) of each member of a structure or enumeration."""
    for comment, declaration in re.findall(r"/\*(.*?)\*/\s*([^;,/]+?)\s*[;,]", body, re.S):
        yield " ".join(declaration.split()), " ".join(words(comment).split())


def table(body):
    rows = "".join(f"| `{name}` | {meaning} |\n" for name, meaning in fields(body))
    return "| member | meaning |\n|---|---|\n" + rows if rows else ""


def page(header):
    top = COMMENT.search(header)
    intro = words(top[1]).replace("\nRules for all functions\n", "\n## Rules for all functions\n\n")
    intro = intro.replace("Generated from src/capi by cbindgen; do not edit.\n", "")
    rest = re.sub(r"^#(?!define SVK).*\n", "", header[top.end():], flags=re.M)
    rest = rest.replace('extern "C" {', "")
    entries = {kind: [] for kind in KINDS}
    pattern = re.compile(r"/\*(?P<doc>(?:(?!\*/).)*)\*/\s*(?P<code>(?:#define[^\n]*\n|(?:typedef |enum )?[^;{]*(?:\{.*?^\}[^;]*)?;))", re.S | re.M)
    for match in pattern.finditer(rest):
        doc, code = words(match["doc"]), match["code"].strip()
        if code.startswith("#define"):
            kind, name = "other", code.split()[1]
        elif "{" in code:
            kind = "enum" if code.startswith("enum") else "struct"
            name = re.match(r"enum (\w+)", code)[1] if kind == "enum" else re.search(r"\}\s*(\w+)", code)[1]
        elif code.startswith("typedef"):
            kind, name = "other", (re.search(r"\(\*(\w+)\)", code) or re.search(r"(\w+);$", code))[1]
        else:
            kind, name = "fn", re.search(r"(\w+)\(", code)[1]
        body = table(code[code.index("{"):]) if "{" in code else f"```c\n{code}\n```\n"
        entries[kind].append(f"### {name}\n\n{doc}\n\n{body}")
    check(header, entries)
    parts = ["# C interface\n\n" + intro]
    parts += [f"## {title}\n\n" + "\n".join(entries[kind]) for kind, title in KINDS.items()]
    return "\n\n".join(parts)


def check(header, entries):
    """Every public name is in the page."""
    text = "\n".join("\n".join(all) for all in entries.values())
    declared = set(re.findall(r"\b(svk_\w+)\(", COMMENT.sub("", header))) | set(re.findall(r"^\} (Svk\w+);", header, re.M))
    lost = sorted(name for name in declared if f"### {name}\n" not in text)
    if lost:
        raise SystemExit(f"include/splatvk.h: docs/site/c_header.py lost {', '.join(lost)}")
