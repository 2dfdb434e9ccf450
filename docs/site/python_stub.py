"""The Python reference: the stub of the binary module with the documentation of the Rust sources, so that nothing is imported."""
import ast, re, shutil

CLASSES = ["Scene", "Answer", "Thing", "Camera", "Event"]
FUNCTIONS = ["reconstruct", "train", "load", "device_name", "close_device"]
# Items that need no words.
PLAIN = {"__new__", "__eq__", "__ne__", "__len__", "__reduce__", "options", "main", "reconstruct"}


def docs_of(sources):
    """Doc comments of `#[pyclass]`, `#[pymethods]` and `#[pyfunction]` items, by name or "Class.name"."""
    docs, scope, lines, name = {}, None, [], None
    for line in "\n".join(path.read_text() for path in sorted(sources)).splitlines():
        text = line.strip()
        if text.startswith("///"):
            lines.append(text[3:].strip())
        elif renamed := re.search(r'^#\[pyo3\(.*?name = "(\w+)"', text):
            name = renamed[1]
        elif item := re.match(r"(?:pub )?(?:(struct|impl|fn) )?(\w+)", text):
            kind, name = item[1], name or item[2]
            if kind in {"struct", "impl"}:
                scope = name
            if lines and kind != "impl":
                docs.setdefault(f"{scope}.{name}" if line.startswith(" ") else name, "\n".join(lines))
            lines, name = [], None
        elif not text.startswith("#["):
            lines, name = [], None
    return {name: re.sub(r"\[`(\w+)`\]", r"`\1`", text) for name, text in docs.items()}


def write(binding, out):
    """Writes the package without its binary module, for griffe."""
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(binding / "python", out, ignore=shutil.ignore_patterns("*.so", "_lib", "__pycache__"))
    stub = out / "splatvk/_splatvk.pyi"
    tree, docs, without = ast.parse(stub.read_text()), docs_of(binding.glob("src/*.rs")), []

    def visit(body, prefix):
        for node in body:
            if not isinstance(node, (ast.ClassDef, ast.FunctionDef)):
                continue
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{node.name}.")
            if text := docs.get(prefix + node.name):
                node.body.insert(0, ast.Expr(ast.Constant(text)))
            elif node.name not in PLAIN:
                without.append(prefix + node.name)

    visit(tree.body, "")
    if without:
        raise SystemExit(f"bindings/python/src: no doc comments of {', '.join(without)}")
    stub.write_text(ast.unparse(tree))


def page():
    parts = [
        "# Python: classes and functions\n\nThe types are those of NumPy arrays: `_Floats` is `NDArray[float32]`, `_Doubles` "
        "`NDArray[float64]`, `_Bools` `NDArray[bool]`. A `_CameraLike` is a `Camera`, or the index or the name of one of the "
        "scene's cameras. [Python](python.md) has the conventions.\n"
    ]
    parts += [f"::: splatvk.{name}\n" for name in FUNCTIONS + CLASSES]
    parts.append("## Errors\n\n::: splatvk.errors\n    options:\n      show_root_heading: false\n      show_root_toc_entry: false\n"
                 "      heading_level: 3\n")
    return "\n".join(parts)
