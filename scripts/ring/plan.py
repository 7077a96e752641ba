"""Plan of a ring: its configuration files, as data.

Sans-I/O. The commands' own ``--check`` accepts these files.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

from gdp.config.config import UplinkPlane
from gdp.limits import ADVERTISEMENT_LEASE_S
from gdp.names import Name
from lab.topology import Attachment, DomainPlan, Topology
from proxy.config.config import Encoding
from proxy.serial.channel import Channel

Yaml: TypeAlias = "dict[str, object]"

METRICS_PORTS: Final = {"switch": 9_101, "rib": 9_102, "proxy": 9_103}  # on the loopback of each namespace
AUTHOR: Final = "ring"


@dataclass(frozen=True, slots=True)
class Credentials:
    """Paths of a node's identity and trust anchors."""

    identity: Path
    root: Path
    trusts: tuple[Path, ...]

    def to_yaml(self) -> Yaml:
        """Return the two keys that every node's file begins with."""
        return {
            "identity": str(self.identity),
            "domain": {"root": str(self.root), "trusts": [str(root) for root in self.trusts]},
        }


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of the recording, with its overlay name."""

    topic: str
    type_name: str
    latched: bool

    @property
    def metadata(self) -> dict[str, str | int]:
        """Return the metadata that the topic's name digests."""
        return {"kind": "topic", "name": self.topic, "type": self.type_name, "author": AUTHOR}


def topics_of(channels: Iterable[Channel]) -> tuple[Topic, ...]:
    """Return each topic once, even if several nodes published it; latched if any of them latched."""
    latched: dict[tuple[str, str], bool] = {}
    for channel in channels:
        key = (channel.topic, channel.type_name)
        latched[key] = latched.get(key, False) or channel.latched
    return tuple(Topic(topic, type_name, latch) for (topic, type_name), latch in latched.items())


def switch_yaml(
    topology: Topology,
    node: str,
    credentials: Credentials,
    data_plane: str,
    *,
    metrics: bool,
    roamers: Collection[Attachment] = (),
    lease_s: float = ADVERTISEMENT_LEASE_S,
) -> Yaml:
    """Return ``switch.yaml`` of one switch.

    Args:
        roamers: proxies that may be attached here or elsewhere; the switch's side of their cable is created elsewhere.
    """
    ports: list[Yaml] = [{"iface": link.other(node), "cost": link.cost} for link in topology.links_of(node)]
    return {
        **credentials.to_yaml(),
        "ports": [*ports, *({"iface": f"{at.ifname}-s", "optional": True} for at in roamers)],
        "attach": [at.ifname for at in topology.attachments if at.switch == node and at not in roamers],
        "data_plane": data_plane,
        "lease_s": lease_s,
        **_metrics("switch", wanted=metrics),
    }


def rib_yaml(
    at: Attachment,
    credentials: Credentials,
    upper: Name | None,
    *,
    metrics: bool,
    data_plane: UplinkPlane = "raw",
    lease_s: float = ADVERTISEMENT_LEASE_S,
) -> Yaml:
    """Return ``rib.yaml`` of one domain's RIB."""
    return {
        **credentials.to_yaml(),
        "iface": at.ifname,
        "upper": upper.to_text() if upper is not None else None,
        "data_plane": data_plane,
        "lease_s": lease_s,
        **_metrics("rib", wanted=metrics),
    }


def rule_yaml(topic: Topic, owner: Path, encoding: Encoding) -> Yaml:
    """Return the rule for a topic: complete, and valid in every domain."""
    return {
        "name": topic.topic,
        "kind": "topic",
        "type": topic.type_name,
        "metadata": {"author": AUTHOR},
        "owner": str(owner),
        "encoding": encoding,
        "reliable": True,
        "latched": topic.latched,
        "global": True,
    }


def proxy_yaml(
    at: Attachment,
    credentials: Credentials,
    delegations: Path,
    rules: Mapping[Literal["expose", "import"], Sequence[Yaml]],
    *,
    metrics: bool,
    data_plane: UplinkPlane = "raw",
    lease_s: float = ADVERTISEMENT_LEASE_S,
) -> Yaml:
    """Return ``proxy.yaml`` of one proxy.

    Args:
        rules: by ``expose`` and ``import``.
    """
    return {
        **credentials.to_yaml(),
        "iface": at.ifname,
        "delegations": str(delegations),
        "data_plane": data_plane,
        "lease_s": lease_s,
        **{side: list(each) for side, each in rules.items()},
        **_metrics("proxy", wanted=metrics),
    }


def upper_rib(topology: Topology, domain: DomainPlan) -> Attachment | None:
    """Return the RIB of the tier above a domain."""
    return topology.rib_of(domain.upper) if domain.upper is not None else None


def _metrics(role: str, *, wanted: bool) -> Yaml:
    return {"metrics": {"port": METRICS_PORTS[role]}} if wanted else {}
