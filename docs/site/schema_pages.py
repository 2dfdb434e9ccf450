"""A page per JSON schema of docs/use/schemas: every key with its type and meaning, an example, and the schema itself."""
import json


def pages(folder):
    schemas = {path.name: json.loads(path.read_text()) for path in sorted(folder.glob("*.schema.json"))}
    for file, schema in schemas.items():
        name = file.removesuffix(".schema.json")
        parts = [f"# {name}\n", f"**{schema.get('title', '')}**\n", schema.get("description", "") + "\n"]
        if rows := list(keys(schema, schema, schemas, "", ())):
            parts.append("| key | type | meaning |\n|---|---|---|")
            # Long keys break behind a dot.
            parts += [f"| <code>{key.replace('.', '.<wbr>')}</code> | {kind} | {text} |" for key, kind, text in rows]
        for example in folder.glob(f"examples/{name}.json*"):
            parts.append(f"\n## Example\n\n```json\n{example.read_text().strip()}\n```\n")
        parts.append(f"\n## Schema\n\n??? note \"{file}\"\n    ```json\n" + indented((folder / file).read_text()) + "\n    ```\n")
        yield name, "\n".join(parts)


def indented(text):
    return "\n".join("    " + line for line in text.strip().splitlines())


def resolved(node, root, schemas):
    """A node with its reference followed; words beside the reference win. Also the schema that holds it, and the reference."""
    reference = node.get("$ref")
    if reference is None:
        return node, root, None
    file, _, pointer = reference.partition("#")
    root = schemas[file] if file else root
    target = root
    for step in pointer.strip("/").split("/") if pointer else []:
        target = target[step]
    return {**target, **{key: value for key, value in node.items() if key != "$ref"}}, root, reference


def kind_of(node, root, schemas):
    """The type of a value in words."""
    if "const" in node:
        return f"`{json.dumps(node['const'])}`"
    if "enum" in node:
        return " or ".join(f"`{json.dumps(value)}`" for value in node["enum"])
    if many := node.get("oneOf") or node.get("anyOf"):
        kinds = [kind_of(resolved(one, root, schemas)[0], root, schemas) for one in many]
        return " or ".join(dict.fromkeys(kinds))
    kinds = node.get("type", "any")
    return " or ".join(kinds) if isinstance(kinds, list) else kinds


def keys(node, root, schemas, path, seen):
    """(key, type, meaning) of everything below a node; keys of array elements are behind `[]`."""
    node, root, reference = resolved(node, root, schemas)
    if reference in seen:
        return
    seen = (*seen, reference) if reference else seen
    for name, value in node.get("properties", {}).items():
        key = f"{path}.{name}" if path else name
        whole, owner, _ = resolved(value, root, schemas)
        optional = "" if name in node.get("required", []) else " *(may be absent)*"
        text = whole.get("description", "").replace("|", "\\|")
        yield key, kind_of(whole, owner, schemas).replace("|", "\\|"), text + optional
        yield from keys(value, root, schemas, key, seen)
    if isinstance(node.get("items"), dict):
        yield from keys(node["items"], root, schemas, path + "[]", seen)
    if isinstance(node.get("additionalProperties"), dict):
        yield from keys(node["additionalProperties"], root, schemas, path + ".*", seen)
    for choice in ("oneOf", "anyOf", "allOf"):
        for one in node.get(choice, []):
            yield from keys(one, root, schemas, path, seen)
