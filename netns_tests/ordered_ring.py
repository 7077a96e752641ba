"""Ring whose RIB of one domain has the least name; arguments: that domain, then those of the ring."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final
from unittest import mock

from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.stores.issue import make_node
from ring import cli

_LEAST: Final = sys.argv.pop(1) if __name__ == "__main__" else ""


def make_ordered_node(directory: Path, role: Role, label: str, domain: Path) -> Identity:
    """Make a node; a RIB's name begins with a small byte in one domain, and with a larger one in the others."""
    identity = make_node(directory, role, label, domain)
    while role is Role.RIB and (identity.name[0] < 0x40) != (domain.name == _LEAST):
        identity = make_node(directory, role, label, domain, force=True)
    return identity


if __name__ == "__main__":
    with mock.patch("lab.credentials.make_node", make_ordered_node):
        cli.main()
