"""Discovery range of ROS 2 for Cyclone DDS: which hosts a participant looks for peers on.

Computes text only. A program without ``rmw`` does not read these variables, so nodes that stay on this host would never
meet it. LOCALHOST means no multicast, and this host as the only peer.
Source: ROS 2 documentation, "Improved dynamic discovery"; Cyclone DDS configuration guide, ``Discovery/Peers``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from gdp.errors import LocalError

_URI: Final = "CYCLONEDDS_URI"
_RANGE: Final = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_LOCALHOST_ONLY: Final = "ROS_LOCALHOST_ONLY"  # until Iron; the range takes precedence
_PARTICIPANTS_MAX: Final = 32
_LOCALHOST: Final = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
    f"<MaxAutoParticipantIndex>{_PARTICIPANTS_MAX}</MaxAutoParticipantIndex>"
    '<Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)
_KNOWN: Final = ("SUBNET", "LOCALHOST", "SYSTEM_DEFAULT")


def with_discovery_range(environment: Mapping[str, str]) -> str | None:
    """Return the value of CYCLONEDDS_URI that obeys the discovery range; None: it needs no change.

    What CYCLONEDDS_URI says already is kept and comes last, so it wins.

    Raises:
        LocalError: a range that this endpoint cannot have, or that ROS does not know.
    """
    stated = environment.get(_RANGE, "").upper()
    if not stated:
        stated = "LOCALHOST" if environment.get(_LOCALHOST_ONLY, "0") not in ("", "0") else "SYSTEM_DEFAULT"
    if stated not in _KNOWN:
        raise LocalError(
            f"{_RANGE}={stated}: the endpoint dds knows {', '.join(_KNOWN)}; with OFF no node could meet the proxy"
        )
    configured = environment.get(_URI, "")
    if stated != "LOCALHOST" or configured.startswith(_LOCALHOST):
        return None
    return ",".join(filter(None, (_LOCALHOST, configured)))
