"""Address of the cluster that stores a RIB's routes.

Sans-I/O; the extension ``cluster`` connects to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["Address", "ClusterAddress"]

Address = tuple[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterAddress:
    """Address and credentials of a cluster.

    Args:
        nodes: some of its servers, as (host, port).
        username, password: of the RIBs' ACL user; empty without ACLs.
        ca: certificate authority of the servers, PEM; None: no TLS.
        cert, key: certificate and key of this RIB, PEM, if the servers require them.
    """

    nodes: tuple[Address, ...]
    username: str = ""
    password: str = ""
    ca: Path | None = None
    cert: Path | None = None
    key: Path | None = None
