#!/usr/bin/env python3
"""Tables of the reference pages, written from the models and docstrings that they describe.

    scripts/docs_reference.py            write the tables of all pages below docs/
    scripts/docs_reference.py --check    print the pages whose tables differ; exit status 1 if there are any

A table stands between two comments. The first one names its source:

    <!-- keys MODULE:MODEL [without KEY... | only KEY...] -->    keys of a section of a configuration file
    <!-- arguments MODULE:CLASS -->                              arguments of a constructor, by its docstring
    <!-- end -->

In ``docs/reference/statements.md`` a list below ``**TYPE, TYPE**`` names keys of bodies. The forms in brackets come
from the bodies' declarations, the meaning stands in the page.
"""

from __future__ import annotations

import importlib
import inspect
import json
import re
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema

from gdp.control.rib_replication import Entry
from gdp.crypto.schema import CERTIFICATE, Body, FieldSet

ROOT: Final = Path(__file__).resolve().parents[1]
_TABLE: Final = re.compile(
    r"(<!-- (keys|arguments) (\S+)(?: (without|only) ([^>]*?))? -->\n).*?(<!-- end -->)", re.DOTALL
)
SECTION: Final = re.compile(r"^\*\*([a-z, -]+)\*\*\n\n((?:- .*\n(?:  .*\n)*)+)", re.MULTILINE)
_BULLET: Final = re.compile(r"^- ([^(:]*`[^(:]*) \([^)]*\): (.*(?:\n  .*)*)", re.MULTILINE)
_ARGUMENT: Final = re.compile(r"^    (\w[\w, ]*): (.*?)(?=^    \w[\w, ]*: |\Z)", re.MULTILINE | re.DOTALL)

Schema: TypeAlias = "dict[str, Any]"


class _Lenient(GenerateJsonSchema):
    """JSON schema in which a type without such a form is a name: a text of 64 hex digits."""

    def handle_invalid_for_json_schema(self, schema: object, error_info: str) -> Schema:  # noqa: ARG002
        return {"type": "name"}


def _range(schema: Schema) -> str:
    low, above = schema.get("minimum"), schema.get("exclusiveMinimum")
    high = schema.get("maximum")
    if above is not None:
        return f">{above:g}" + ("" if high is None else f",≤{high:.15g}")
    if low is None:
        return str(schema["type"]) if high is None else f"≤{high:.15g}"
    return f"≥{low:.15g}" if high is None else f"{low:.15g}–{high:.15g}"


def _type(schema: Schema, known: Schema) -> str:
    """Return the kind of value in one word, with its bounds."""
    if "$ref" in schema:
        return _type(known[schema["$ref"].rpartition("/")[2]], known)
    if "anyOf" in schema:
        return "/".join(dict.fromkeys(_type(each, known) for each in schema["anyOf"] if each.get("type") != "null"))
    if "enum" in schema or "const" in schema:
        return "/".join(f"`{each}`" for each in schema.get("enum", [schema.get("const")]))
    match schema.get("type"):
        case "integer" | "number":
            return _range(schema)
        case "array":
            items = schema.get("items", {})
            return f"[{_type(items, known)}]" if isinstance(items, dict) and items else "list"
        case "string":
            return "path" if schema.get("format") == "path" else "text"
        case "boolean":
            return "bool"
        case "object":
            return "map"
        case other:
            return other or "any"


def _section(schema: Schema, known: Schema) -> tuple[Schema | None, bool]:
    """Return the section that a key holds, and whether it holds a list of such."""
    if "$ref" in schema:
        found = known[schema["$ref"].rpartition("/")[2]]
        return (found if "properties" in found else None), False
    if schema.get("type") == "array":
        return _section(schema.get("items", {}), known)[0], True
    for each in schema.get("anyOf", ()):
        found, is_list = _section(each, known)
        if found is not None:
            return found, is_list
    return None, False


def _value(schema: Schema, known: Schema, is_required: bool) -> str:
    """Return default and kind: ``?`` stands for a default of null, an empty list or map needs no default."""
    kind, default = _type(schema, known), schema.get("default")
    if is_required:
        return f"{kind}, required"
    if default is None:
        return kind if kind == "map" and "anyOf" not in schema else f"{kind}?"
    shown = default if isinstance(default, str) and default else json.dumps(default)
    choice = f"`{shown}`"
    if choice in kind.split("/"):
        return kind.replace(choice, f"**{choice}**", 1)
    if isinstance(default, bool) or kind == "text":
        return choice
    return kind if not default and isinstance(default, list) else f"{choice} ({kind})"


def _rows(section: Schema, known: Schema, prefix: str = "") -> Iterator[tuple[str, str, str]]:
    for key, schema in section["properties"].items():
        inner, is_list = _section(schema, known)
        is_plain = inner is None or is_list or "anyOf" in schema
        if is_plain:
            yield prefix + key, _value(schema, known, key in section.get("required", ())), schema.get("description", "")
        if inner is not None and inner is not section:
            yield from _rows(inner, known, f"{prefix}{key}{'[]' if is_list else ''}.")


def _keys(model: type[BaseModel], rule: str, named: Sequence[str]) -> Iterator[str]:
    schema = model.model_json_schema(schema_generator=_Lenient)
    yield "| key | value | what |\n|---|---|---|\n"
    known = schema.get("$defs", {})
    for key, value, text in _rows(known.get(schema.get("$ref", "").rpartition("/")[2], schema), known):
        if not rule or (key.partition(".")[0].partition("[")[0] in named) is (rule == "only"):
            yield f"| `{key}` | {value} | {text.replace('|', chr(92) + '|')} |\n"


def _arguments(cls: type) -> Iterator[str]:
    parameters = inspect.signature(cls).parameters
    yield "| keyword | default | what |\n|---|---|---|\n"
    section = inspect.cleandoc(cls.__doc__ or "").partition("Args:\n")[2].partition("\n\n")[0]
    for names, text in _ARGUMENT.findall(section):
        first = parameters.get(names.partition(",")[0])
        default = "required" if first is None or first.default is first.empty else f"`{first.default!r}`"
        shown = ", ".join(f"`{name}`" for name in names.split(", "))
        yield f"| {shown} | {default} | {' '.join(text.split()).replace('``', '`')} |\n"


def written(page: str) -> str:
    """Return the text of a page with its tables as their sources say."""

    def table(match: re.Match[str]) -> str:
        module, _, name = match[3].partition(":")
        source = getattr(importlib.import_module(module), name)
        lines = (
            _arguments(source) if match[2] == "arguments" else _keys(source, match[4] or "", (match[5] or "").split())
        )
        return f"{match[1]}\n{''.join(lines)}\n{match[6]}"

    return _TABLE.sub(table, page)


def bodies() -> dict[str, list[type[FieldSet]]]:
    """Return the declared bodies by the type of their statement, and the entry of a batch."""
    for path in sorted((ROOT / "gdp").rglob("*.py")):
        if "gdp.crypto.schema import" in path.read_text():
            importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    found: dict[str, list[type[FieldSet]]] = {"entry": [Entry]}
    kinds = Body.__subclasses__()
    for kind in kinds:
        kinds += kind.__subclasses__()
        if kind.__module__.startswith("gdp."):
            found.setdefault(kind.TYPE.value, []).append(kind)
    return found


def _with_forms(section: re.Match[str], known: dict[str, list[type[FieldSet]]]) -> str:
    """Return a list of keys with the forms that are declared."""
    kinds = [kind for type_ in section[1].split(", ") for kind in known[type_]]
    declared = {CERTIFICATE.key: CERTIFICATE} | {key.key: key for kind in kinds for key in kind.declared()}

    def bullet(match: re.Match[str]) -> str:
        keys = [declared[key] for key in re.findall("`([^`]+)`", match[1])]
        forms = [key.form.words + ("" if key.is_required else ", optional") for key in keys]
        line = f"- {match[1]} ({'; '.join(forms if len(set(forms)) > 1 else forms[:1])}): {match[2]}"
        return textwrap.fill(
            " ".join(line.split()), 120, subsequent_indent="  ", break_on_hyphens=False, break_long_words=False
        )

    return f"**{section[1]}**\n\n{_BULLET.sub(bullet, section[2])}"


def statements(page: str) -> str:
    """Return the text of the page about statements with the forms of keys as they are declared."""
    known = bodies()
    return SECTION.sub(lambda section: _with_forms(section, known), page)


def main(argv: Sequence[str]) -> int:
    """Run the command; return its exit status."""
    pages = {page: page.read_text() for page in sorted((ROOT / "docs").rglob("*.md"))}
    made = {page: (statements if page.name == "statements.md" else written)(text) for page, text in pages.items()}
    differ = {page: new for page, new in made.items() if new != pages[page]}
    for page, new in differ.items():
        if "--check" in argv:
            print(f"{page.relative_to(ROOT)}: a table differs from its source (run scripts/docs_reference.py)")
        else:
            page.write_text(new)
    return 1 if differ and "--check" in argv else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
