"""Credentials of a ring: keys, certificates, delegations and configuration files in the run's own directory.

I/O. Every run has new keys, which are deleted with it::

    domains/<label>/      a root each
    owner/                the robot's owner
    nodes/<role>-<switch>/    identity, delegations
    <role>-<switch>.yaml      configuration
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Final, Literal

import yaml

from gdp.config.config import UplinkPlane
from gdp.crypto.certificates import Role
from gdp.limits import ADVERTISEMENT_LEASE_S
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.stores.issue import delegate, install_delegation, make_domain, make_node, make_owner
from gdp.stores.keyring import CARD, DELEGATIONS, OWNER_PUBLIC, ROOT_CERTIFICATE
from gdp.trust.right import Right
from lab.topology import Attachment, Topology
from proxy.config.config import Encoding
from proxy.serial.channel import RosVersion
from ring.live_plan import Carried, Side
from ring.plan import Credentials, Topic, Yaml, proxy_yaml, rib_yaml, rule_yaml, switch_yaml, upper_rib

_SIDES: Final[dict[Side, Right]] = {"expose": Right.PUBLISH, "import": Right.READ}


class OverlayCredentials:
    """The files of one run. Its creation creates the domains and admits the switches and RIBs.

    Args:
        roamers: proxies that will also be attached to other switches.
        data_plane: of RIBs and proxies.
    """

    def __init__(
        self,
        topology: Topology,
        directory: Path,
        *,
        metrics: bool,
        roamers: Collection[Attachment] = (),
        lease_s: float = ADVERTISEMENT_LEASE_S,
        data_plane: UplinkPlane = "raw",
    ) -> None:
        self._data_plane = data_plane
        self._roamers = roamers
        self._lease_s = lease_s
        self._topology = topology
        self._directory = directory
        self._metrics = metrics
        self._owner = directory / "owner"
        for domain in topology.domains:
            make_domain(self._domain(domain.label), domain.label)
        make_owner(self._owner)
        self._names: dict[str, Name] = {}
        for node in topology.nodes:
            self._admit(Role.SWITCH, node)
        for at in topology.attachments:
            self._admit(Role(at.role), at.switch)

    def switch(self, node: str, data_plane: str) -> Path:
        """Write ``switch.yaml`` of a switch; return the file."""
        credentials = self._credentials(Role.SWITCH, node)
        content = switch_yaml(
            self._topology,
            node,
            credentials,
            data_plane,
            metrics=self._metrics,
            roamers=self._roamers,
            lease_s=self._lease_s,
        )
        return self._write(Role.SWITCH, node, content)

    def rib(self, at: Attachment) -> Path:
        """Write ``rib.yaml`` of a RIB; return the file."""
        upstream = upper_rib(self._topology, self._topology.domain_of(at.switch))
        upper = self._names[_title(Role.RIB, upstream.switch)] if upstream is not None else None
        content = rib_yaml(
            at,
            self._credentials(Role.RIB, at.switch),
            upper,
            metrics=self._metrics,
            data_plane=self._data_plane,
            lease_s=self._lease_s,
        )
        return self._write(Role.RIB, at.switch, content)

    def sender(self, at: Attachment, topics: Sequence[Topic], encoding: Encoding, ros: RosVersion) -> Path:
        """Give a proxy the right to publish these topics, and write its ``proxy.yaml``; return the file."""
        return self._proxy(at, "expose", topics, encoding, ros, None)

    def receiver(
        self, at: Attachment, topics: Sequence[Topic], encoding: Encoding, ros: RosVersion, record: Path
    ) -> Path:
        """Give a proxy the right to read these topics, and write the ``proxy.yaml`` that records them; return it."""
        return self._proxy(at, "import", topics, encoding, ros, record)

    def live(self, at: Attachment, side: Side, carried: Sequence[Carried], encoding: Encoding, graph: Yaml) -> Path:
        """Give a proxy the rights of its side, and write the ``proxy.yaml`` for its graph; return the file."""
        node = self._node(Role.PROXY, at.switch)
        for each in carried:
            self._delegate(node, each.metadata, each.right(side))
        rules = {side: [each.rule(self._owner / OWNER_PUBLIC, encoding) for each in carried]}
        return self._write_proxy(at, rules, {"ros": graph})

    def of_proxy(self, switch: str) -> Credentials:
        """Return identity and trust anchors of the proxy at a switch."""
        return self._credentials(Role.PROXY, switch)

    def proxy_file(self, at: Attachment) -> Path:
        """Return the path of a proxy's ``proxy.yaml``."""
        return self.file("proxy", at.switch)

    def file(self, role: Literal["switch", "rib", "proxy"], switch: str) -> Path:
        """Return the path of a node's configuration."""
        return self._directory / f"{_title(Role(role), switch)}.yaml"

    def _proxy(
        self,
        at: Attachment,
        side: Side,
        topics: Sequence[Topic],
        encoding: Encoding,
        ros: RosVersion,
        record: Path | None,
    ) -> Path:
        node = self._node(Role.PROXY, at.switch)
        for topic in topics:
            self._delegate(node, Metadata(topic.metadata), _SIDES[side])
        rules = {side: [rule_yaml(topic, self._owner / OWNER_PUBLIC, encoding) for topic in topics]}
        form = "ros1" if ros == 1 else "mcap"
        recorded: Yaml = {} if record is None else {"record": {"path": str(record), "format": form}}
        return self._write_proxy(at, rules, recorded)

    def _write_proxy(self, at: Attachment, rules: Mapping[Side, Sequence[Yaml]], further: Yaml) -> Path:
        content = proxy_yaml(
            at,
            self._credentials(Role.PROXY, at.switch),
            self._node(Role.PROXY, at.switch) / DELEGATIONS,
            rules,
            metrics=self._metrics,
            data_plane=self._data_plane,
            lease_s=self._lease_s,
        )
        return self._write(Role.PROXY, at.switch, {**content, **further})

    def _delegate(self, node: Path, metadata: Metadata, right: Right) -> None:
        given = delegate(self._owner, node / CARD, metadata, [right])
        install_delegation(node, given, force=True)  # a kept proxy starts a second time

    def _admit(self, role: Role, switch: str) -> None:
        domain = self._domain(self._topology.domain_of(switch).label)
        identity = make_node(self._node(role, switch), role, _title(role, switch), domain)
        self._names[_title(role, switch)] = identity.name

    def _credentials(self, role: Role, switch: str) -> Credentials:
        own = self._topology.domain_of(switch).label
        others = [domain.label for domain in self._topology.domains if domain.label != own]
        return Credentials(
            identity=self._node(role, switch),
            root=self._domain(own) / ROOT_CERTIFICATE,
            trusts=tuple(self._domain(label) / ROOT_CERTIFICATE for label in others),
        )

    def _domain(self, label: str) -> Path:
        return self._directory / "domains" / label

    def _node(self, role: Role, switch: str) -> Path:
        return self._directory / "nodes" / _title(role, switch)

    def _write(self, role: Role, switch: str, content: Yaml) -> Path:
        path = self._directory / f"{_title(role, switch)}.yaml"
        path.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")
        return path


def _title(role: Role, switch: str) -> str:
    return f"{role.value}-{switch}"
