"""JSON Schema (2020-12) of a configuration file for editors, generated from its model.

Sans-I/O. An editor with a YAML language server completes and checks a file that begins with
``# yaml-language-server: $schema=proxy.schema.json``. JSON Schema cannot check that files exist or that rules clash;
``gdp-proxy --check`` does that.
"""

from __future__ import annotations

from typing import Final, TypeAlias

from gdp.nodes.schema import Section

__all__ = ["DIALECT", "JsonSchema", "editor_schema"]

JsonSchema: TypeAlias = "dict[str, object]"

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"

_SHARED: Final = {  # keys of every node's file; docs/reference/configuration.md describes them in full
    ("Domain", "root"): "Root certificate of the node's own trust domain.",
    ("Domain", "trusts"): "Root certificates of other domains whose members are believed.",
    ("Domain", "transit"): "Labels of the domains through which traffic may pass. `null`: every trusted one.",
    ("Metrics", "port"): "TCP port on 127.0.0.1.",
}


def editor_schema(model: type[Section], title: str) -> JsonSchema:
    """Return the schema of a file; every key in it has a description."""
    schema = model.model_json_schema(by_alias=True)
    sections = schema.get("$defs", {})
    for (section, key), text in _SHARED.items():
        if section in sections:
            sections[section]["properties"][key].setdefault("description", text)
    for each in (schema, *sections.values()):
        del each["title"]
        each["description"] = each["description"].replace("``", "`")
        for key in each["properties"].values():
            key.pop("title", None)  # derived from Python's names, and displayed in place of the keys
    return {"$schema": DIALECT, "title": title, **schema}
