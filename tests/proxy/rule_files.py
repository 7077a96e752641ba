"""Files of rules, for tests: a folder with keys, and the result of loading a text there."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.config.yaml_source import ConfigFileError
from gdp.crypto.keys import SigningKey
from proxy.config.config import ProxyConfig, Rule

OWNER = SigningKey.generate()
OTHER = SigningKey.generate()
NODE = """\
identity: id
domain: {root: root.crt}
iface: robot
delegations: id
"""
FIRST_LINE = NODE.count("\n") + 1


def furnish(folder: Path) -> None:
    """Create the files that the rules name."""
    (folder / "id").mkdir()
    (folder / "root.crt").write_text("a certificate")
    (folder / "owner.pub").write_bytes(OWNER.public.to_pem())
    (folder / "other.pub").write_bytes(OTHER.public.to_pem())


def proxy(folder: Path, text: str) -> ProxyConfig:
    """Return the configuration of this text, after the keys of every node."""
    (folder / "proxy.yaml").write_text(NODE + text)
    return ProxyConfig.load(folder / "proxy.yaml")


def rules(*texts: str) -> str:
    """Return rules of the one owner, each a line, from the keys within the braces."""
    return "".join(f"  - {{{text}{'' if 'owner:' in text else ', owner: owner.pub'}}}\n" for text in texts)


def rule(folder: Path, text: str) -> Rule:
    """Return one rule; a graph is there for services and actions."""
    return proxy(folder, f"ros: {{endpoint: ros2, domain: 0}}\nexpose:\n{rules(text)}").expose[0]


def refusals(folder: Path, text: str) -> list[str]:
    """Return the error about a text, without the folder."""
    with pytest.raises(ConfigFileError) as caught:
        proxy(folder, text)
    return str(caught.value).replace(f"{folder}/", "").splitlines()
