"""The keys of a configuration file for editors: JSON Schema 2020-12, made from its model.

Place: pure. An editor with a YAML language server completes and checks a file that begins with
``# yaml-language-server: $schema=proxy.schema.json``. What JSON Schema cannot say (files that exist, rules that clash)
is for ``gdp-proxy --check``.
"""

from __future__ import annotations

from typing import Final, TypeAlias

from gdp.nodes.schema import Section

__all__ = ["DIALECT", "JsonSchema", "editor_schema"]

JsonSchema: TypeAlias = "dict[str, object]"

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"

_SHARED: Final = {  # keys that every node's file has; docs/reference/configuration.md says more about them
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
            key.pop("title", None)  # made of Python's names, and shown in place of the keys
    return {"$schema": DIALECT, "title": title, **schema}
