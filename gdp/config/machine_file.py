"""``machine.yaml``: one configuration file for all nodes of a machine.

I/O; reads the file. Each node's command reads its own section, so it accepts this file in place of its own::

    domain: {root: switch/root.crt}     # optional; default: root.crt next to each node's keys
    switch: {ports: [{iface: eth0}]}    # keys of switch.yaml
    rib: {}                             # keys of rib.yaml; without the section no RIB runs here
    proxy: proxy.yaml                   # that file, or its keys
    store: {holds: {folder: capsules}}  # keys of store.yaml

A section that leaves out ``identity`` means the folder of its own name. The switch attaches the other sections, at
``rib0``, ``proxy0`` and ``store0``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from gdp.config.yaml_source import KeyPath, Mark, Plain, YamlSource, read_yaml

MACHINE_FILE: Final = "machine.yaml"
NODE_SECTIONS: Final = ("switch", "relay", "rib", "proxy")  # those with a control socket
SECTIONS: Final = (*NODE_SECTIONS, "store")  # in the order of their start
_DOMAIN: Final = "domain"
_ATTACHED: Final = ("rib", "proxy", "store")


def read_sections(path: Path) -> Mapping[str, Path]:
    """Return the file that configures each node of a machine, by section: this one, or the one that a section names.

    The file of a proxy may be missing: the first start writes it.

    Raises:
        ConfigError: it is no ``machine.yaml``; the text names the line.
    """
    source = read_yaml(path)
    data = _checked(source)
    if not data.keys() & set(SECTIONS):
        raise source.error((), f"expected at least one of the sections {', '.join(SECTIONS)}")
    found = dict[str, Path]()
    for section in SECTIONS:
        stated = data.get(section)
        if isinstance(stated, str):
            found[section] = path.parent / stated
            if section != "proxy" and not found[section].is_file():
                raise source.error((section,), f"no such file: {found[section]}")
        elif section in data:
            section_source(source, section)
            found[section] = path
    return found


def section_source(source: YamlSource, section: str) -> YamlSource:
    """Return a node's section with the defaults of ``machine.yaml``, or the file itself where it has no such section.

    Raises:
        ConfigError: the section is no mapping, or the file has unknown ones.
    """
    if not section or not isinstance(source.data, dict) or section not in source.data:
        return source
    whole = _checked(source)
    stated = whole[section]
    if isinstance(stated, str):
        raise source.error((section,), f"this node's configuration is in {stated}: name that file")
    if stated is not None and not isinstance(stated, dict):
        raise source.error((section,), "expected a mapping of keys to values, or the name of a file")
    own = stated or {}
    defaults: dict[str, Plain] = {"identity": section}
    defaults[_DOMAIN] = whole.get(_DOMAIN, {"root": f"{own.get('identity', section)}/root.crt"})
    if section == "switch":
        defaults["attach"] = [f"{each}0" for each in _ATTACHED if each in whole]
    elif section in _ATTACHED:
        defaults["iface"] = f"{section}0"
    keys, values = (_within(marks, section) for marks in (source.keys, source.values))
    return YamlSource(source.path, {**defaults, **own}, keys, values)


def _within(marks: Mapping[KeyPath, Mark], section: str) -> dict[KeyPath, Mark]:
    """Return the positions of a section's keys, and of the keys of the common domain."""
    common = {key: mark for key, mark in marks.items() if key[:1] == (_DOMAIN,)}
    return {**common, **{key[1:]: mark for key, mark in marks.items() if key[:1] == (section,)}}


def _checked(source: YamlSource) -> dict[str, Plain]:
    if not isinstance(source.data, dict):
        raise source.error((), "expected a mapping of keys to values")
    known = (_DOMAIN, *SECTIONS)
    for key in source.data:
        if key not in known:
            raise source.error((key,), f"unknown key; expected one of {', '.join(known)}", at_key=True)
    return source.data
