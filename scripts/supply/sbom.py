#!/usr/bin/env python3
"""Software bill of materials of a lock: CycloneDX 1.6, JSON.

    .venv/bin/python scripts/supply/sbom.py --lock requirements/run.lock -o sbom.cdx.json

Components and hashes come from the lock. Licences and the graph of dependencies come from the metadata of what is
installed, for the packages that are installed in the pinned version. The same inputs give the same bytes: the serial
number is derived from the content, and a time stands in it only where SOURCE_DATE_EPOCH gives one.

``cyclonedx-bom`` lists the pins of a lock with their hashes, but neither licences nor dependencies.

Source: https://cyclonedx.org/docs/1.6/json/; package URLs: https://github.com/package-url/purl-spec;
locks: pip's "Requirements File Format" and "Secure installs"; names as in PEP 503, markers as in PEP 508.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import os
import re
import sys
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = None

ROOT = Path(__file__).parents[2]
_PIN = re.compile(r"(?P<name>[\w.\-]+)(?:\[[\w,.\- ]+\])?==(?P<version>[\w.!+\-]+)(?: *; *(?P<marker>[^\\]+?))?\Z")
_HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})\Z")
_LICENCE_MAX_CHARS = 200  # some packages put the whole text there


class LockError(Exception):
    """File that is not a lock; the text names the line."""


@dataclass(frozen=True)
class Pin:
    """One version of one package.

    ``name``: as PEP 503 writes it. ``marker``: condition; empty: everywhere. ``hashes``: SHA-256 of each archive that
    may be installed, hex.
    """

    name: str
    version: str
    marker: str
    hashes: frozenset[str]


def read_lock(path: Path) -> list[Pin]:
    """Return the pins of a lock, in order.

    Raises ``LockError``: a line that is neither a pin with hashes nor a comment. Raises ``OSError``: it cannot be read.
    """
    pins: list[Pin] = []
    joined = ""
    for number, line in enumerate(path.read_text().splitlines(), 1):
        text = line.strip()
        if not joined and (not text or text.startswith("#")):
            continue
        joined += " " + text.removesuffix("\\").strip()
        if text.endswith("\\"):
            continue
        requirement, *options = re.split(r" (?=--)", joined.strip())
        match, hashes = _PIN.match(requirement.strip()), [_HASH.match(option.strip()) for option in options]
        if match is None or not hashes or None in hashes:
            raise LockError(f"{path}:{number}: expected name==version with --hash=sha256:HEX")
        digests = frozenset(each[1] for each in hashes if each)
        pins.append(Pin(canonicalize_name(match["name"]), match["version"], (match["marker"] or "").strip(), digests))
        joined = ""
    return pins


def bill(pins: Sequence[Pin], name: str, version: str, direct: Sequence[str], epoch_s: int | None) -> dict[str, Any]:
    """Return the document.

    ``direct``: names of the direct requirements of the project. ``epoch_s``: creation time, unix seconds; None: not
    stated.
    """
    ordered = sorted(pins, key=lambda pin: (pin.name, pin.version, pin.marker))
    found = {pin: _installed(pin) for pin in ordered}
    refs: dict[str, list[str]] = {}
    for pin in ordered:
        if _purl(pin) not in refs.setdefault(pin.name, []):
            refs[pin.name].append(_purl(pin))
    own = f"pkg:pypi/{canonicalize_name(name)}@{version}"
    edges = {own: sorted({ref for each in direct for ref in refs.get(canonicalize_name(each), ())})}
    for pin, dist in found.items():
        needs = {ref for each in _requires(dist) for ref in refs.get(each, ())} if dist else set()
        edges[_purl(pin)] = sorted(needs - {_purl(pin)})
    components = {_purl(pin): _component(pin, dist) for pin, dist in found.items()}
    digest = hashlib.sha256(json.dumps([own, components, edges], sort_keys=True).encode()).hexdigest()
    metadata: dict[str, Any] = {
        "component": {"type": "application", "bom-ref": own, "name": name, "version": version, "purl": own}
    }
    if epoch_s is not None:
        metadata["timestamp"] = datetime.datetime.fromtimestamp(epoch_s, datetime.timezone.utc).isoformat()
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, digest)}",
        "version": 1,
        "metadata": metadata,
        "components": list(components.values()),
        "dependencies": [{"ref": ref, "dependsOn": needs} for ref, needs in sorted(edges.items())],
    }


def main(words: Sequence[str] | None = None) -> int:
    """Run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lock", type=Path, required=True, help="a file of requirements/")
    parser.add_argument("-o", "--out", type=Path, help="where to; else standard output")
    given = parser.parse_args(words)
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        name, version, direct = project(ROOT / "pyproject.toml")
        document = bill(read_lock(given.lock), name, version, direct, int(epoch) if epoch else None)
    except (LockError, OSError, ValueError) as error:
        print(f"sbom: {error}", file=sys.stderr)
        return 2
    text = json.dumps(document, indent=2) + "\n"
    if given.out:
        given.out.write_text(text)
    else:
        print(text, end="")
    return 0


def project(path: Path) -> tuple[str, str, list[str]]:
    """Return name, version and the required names of a pyproject.toml.

    Raises ``ValueError``: this Python cannot read TOML (it is in 3.11 and later).
    """
    if tomllib is None:
        raise ValueError("Python 3.11 or later is needed to read pyproject.toml")
    table = tomllib.loads(path.read_text())["project"]
    return table["name"], table["version"], [Requirement(each).name for each in table["dependencies"]]


def _purl(pin: Pin) -> str:
    return f"pkg:pypi/{pin.name}@{pin.version}"


def _component(pin: Pin, dist: Distribution | None) -> dict[str, Any]:
    component: dict[str, Any] = {
        "type": "library",
        "bom-ref": _purl(pin),
        "name": pin.name,
        "version": pin.version,
        "purl": _purl(pin),
        "externalReferences": [
            {
                "type": "distribution",
                "url": f"https://pypi.org/project/{pin.name}/{pin.version}/",
                "hashes": [{"alg": "SHA-256", "content": digest} for digest in sorted(pin.hashes)],
            }
        ],
    }
    if pin.marker:
        component["properties"] = [{"name": "gdp:marker", "value": pin.marker}]
    if dist is not None and (licences := _licences(dist)):
        component["licenses"] = licences
    return component


def _licences(dist: Distribution) -> list[dict[str, Any]]:
    """Return the licence of a package: an SPDX expression, else its words."""
    if expressions := dist.metadata.get_all("License-Expression"):
        return [{"expression": expressions[0]}]
    words = [
        each.rpartition(" :: ")[2] for each in dist.metadata.get_all("Classifier", []) if each.startswith("License ::")
    ]
    text = "".join(dist.metadata.get_all("License", [])[:1]).strip()
    if not words and text and len(text) <= _LICENCE_MAX_CHARS and "\n" not in text:
        words = [text]
    return [{"license": {"name": each}} for each in words]


def _installed(pin: Pin) -> Distribution | None:
    try:
        dist = distribution(pin.name)
    except PackageNotFoundError:
        return None
    return dist if dist.version == pin.version else None


def _requires(dist: Distribution) -> set[str]:
    """Return the requirements of a package here, without extras, by name."""
    names: set[str] = set()
    for text in dist.requires or ():
        try:
            requirement = Requirement(text)
        except InvalidRequirement:
            continue
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            names.add(canonicalize_name(requirement.name))
    return names


if __name__ == "__main__":
    sys.exit(main())
