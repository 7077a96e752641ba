"""How a RIB reaches the cluster that keeps its routes.

Layer: I/O, without any; the client library, an optional extra, is imported by ``cluster_link.py`` alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["Address", "ClusterAddress"]

Address = tuple[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterAddress:
    """How to reach a cluster.

    Args:
        nodes: some of its servers, as (host, port).
        username, password: of the RIBs' ACL user; empty without ACLs.
        ca: certificate authority of the servers, PEM; None: no TLS.
        cert, key: what this RIB shows the servers, PEM, where they want it.
    """

    nodes: tuple[Address, ...]
    username: str = ""
    password: str = ""
    ca: Path | None = None
    cert: Path | None = None
    key: Path | None = None
