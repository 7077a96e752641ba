"""The delegations of a proxy: the store that all nodes have (``gdp/nodes/delegation_store.py``).

Layer: I/O; it reads files.
"""

from __future__ import annotations

from gdp.nodes.delegation_store import DelegationStore as Held
from gdp.nodes.delegation_store import open_delegation

__all__ = ["Held", "open_delegation"]
