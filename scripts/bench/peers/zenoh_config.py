"""Configuration of a Zenoh process, as both benches with Zenoh use it: no shared memory, no scouting, mutual TLS.

Shared memory is off everywhere: it would cross namespaces of one host, and its figures are not those of a network.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import zenoh


def zenoh_config(
    mode: str, *, listen: Sequence[str] = (), connect: Sequence[str] = (), certificate: str | None = None
) -> zenoh.Config:
    """Return the configuration of a router, client or peer.

    Args:
        certificate: path without its ending, of a host of ``make_certificates``; None: no TLS.
    """
    config: zenoh.Config = zenoh.Config()
    values: dict[str, object] = {
        "mode": mode,
        "transport/shared_memory/enabled": False,
        "scouting/multicast/enabled": False,
    }
    if listen:
        values["listen/endpoints"] = list(listen)
    if connect:
        values["connect/endpoints"] = list(connect)
    if certificate is not None:
        values["transport/link/tls"] = {
            "root_ca_certificate": f"{certificate.rpartition('/')[0]}/ca.crt",
            "enable_mtls": True,
            "verify_name_on_connect": True,
            **{f"{side}_private_key": f"{certificate}.key" for side in ("listen", "connect")},
            **{f"{side}_certificate": f"{certificate}.crt" for side in ("listen", "connect")},
        }
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config
