"""Credentials of an overlay: keys, certificates, delegations and configuration files of a topology's nodes.

I/O. Every run has new keys, which are deleted with it; the commands' own ``--check`` accepts the files::

    domains/<label>/      a root each
    owner/                the owner of all names
    nodes/<role>-<node>/      identity, delegations
    <role>-<node>.yaml        configuration
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, TypeAlias

import yaml

from gdp.crypto.certificates import Role
from gdp.intervals import ADVERTISEMENT
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.stores.issue import delegate, install_delegation, make_domain, make_node, make_owner
from gdp.stores.keyring import CARD, DELEGATIONS, OWNER_PUBLIC, ROOT_CERTIFICATE
from gdp.trust.right import Right, right_on
from lab.topology import Attachment, Topology

Yaml: TypeAlias = "dict[str, object]"
Side = Literal["expose", "import"]
Kind = Literal["topic", "service", "action", "node"]
NameRights = Mapping[str, Collection[Right]]

_DOMAIN: Final = "lab"

METRICS_PORTS: Final = {"switch": 9_101, "rib": 9_102, "proxy": 9_103}  # on the loopback of each namespace


@dataclass(frozen=True, slots=True)
class Carried:
    """A name that proxies carry; ``options``: further keys of its rules."""

    name: str
    type_name: str
    kind: Kind = "topic"
    options: Mapping[str, object] = field(default_factory=dict)
    author: str = ""

    @property
    def _further(self) -> dict[str, str]:
        return {"author": self.author} if self.author else {}

    @property
    def metadata(self) -> Metadata:
        """Return the metadata that its overlay name digests."""
        name = f"/{self.options['prefix']}{self.name}" if "prefix" in self.options else self.name
        return Metadata({"kind": self.kind, "name": name, "type": self.type_name, **self._further})

    def right(self, side: Side) -> Right:
        """Return the right that the proxy of one side needs."""
        return right_on(self.kind, gives=side == "expose")

    def rule(self, owner: Path) -> Yaml:
        """Return its rule in either ``proxy.yaml``."""
        keys = {"name": self.name, "kind": self.kind, "type": self.type_name, "owner": str(owner)}
        return {**keys, **({"metadata": self._further} if self.author else {}), **self.options}


class OverlayCredentials:
    """The files of one overlay. Its creation creates the domains and admits all nodes of the topology.

    ``roamers``: proxies that will also be attached to other switches; their cables are created elsewhere. ``uplink``:
    further keys of every RIB and proxy.
    """

    def __init__(
        self,
        topology: Topology,
        folder: Path,
        *,
        metrics: bool = False,
        roamers: Collection[Attachment] = (),
        lease_s: float = ADVERTISEMENT.lease_s,
        uplink: Mapping[str, object] | None = None,
    ) -> None:
        self.folder, self.owner = folder, folder / "owner"
        self.topology, self._roamers, self._has_metrics = topology, roamers, metrics
        self._lease: Yaml = {"lease_s": lease_s}
        self._uplink = uplink or {}
        for domain in topology.domains:
            make_domain(self.domain(domain.label), domain.label)
        make_owner(self.owner)
        self._names: dict[tuple[Role, str], Name] = {}
        for node in topology.nodes:
            self.admit(Role.SWITCH, node, node)
        for at in topology.attachments:
            self.admit(Role(at.role), at.switch, at.switch)

    @property
    def owner_key(self) -> Path:
        """The public key of the owner of all names."""
        return self.owner / OWNER_PUBLIC

    def domain(self, label: str) -> Path:
        """Return the folder of a domain."""
        return self.folder / "domains" / label

    def identity(self, role: Role, label: str) -> Path:
        """Return the folder of a node's keys."""
        return self.folder / "nodes" / f"{role.value}-{label}"

    def file(self, role: Literal["switch", "rib", "proxy"], label: str) -> Path:
        """Return the path of a node's configuration."""
        return self.folder / f"{role}-{label}.yaml"

    def admit(self, role: Role, label: str, switch: str) -> Path:
        """Make the keys of a node in the domain of a switch, unless it has some; return their folder."""
        identity = self.identity(role, label)
        if (role, label) not in self._names:
            domain = self.domain(self.topology.domain_of(switch).label)
            self._names[role, label] = make_node(identity, role, f"{role.value}-{label}", domain).name
        return identity

    def name(self, role: Role, label: str) -> Name:
        """Return the name of a node."""
        return self._names[role, label]

    def node_yaml(self, role: Role, label: str, switch: str | None = None) -> Yaml:
        """Return the two keys that every node's file begins with; ``switch``: one of its domain."""
        own = self.topology.domain_of(switch or label).label
        roots = {each.label: str(self.domain(each.label) / ROOT_CERTIFICATE) for each in self.topology.domains}
        return {
            "identity": str(self.identity(role, label)),
            "domain": {"root": roots.pop(own), "trusts": list(roots.values())},
        }

    def ports(self, node: str) -> list[Yaml]:
        """Return the ports of a switch: one a link."""
        return [{"iface": link.other(node), "cost": link.cost} for link in self.topology.links_of(node)]

    def switch(self, node: str, data_plane: str, **further: object) -> Path:
        """Write ``switch.yaml`` of a switch; return the file."""
        attached = (at for at in self.topology.attachments if at.switch == node and at not in self._roamers)
        content = {
            **self.node_yaml(Role.SWITCH, node),
            "ports": [*self.ports(node), *({"iface": f"{at.ifname}-s", "optional": True} for at in self._roamers)],
            "attach": [at.ifname for at in attached],
            "data_plane": data_plane,
            **self._lease,
        }
        return self._write("switch", node, {**content, **further})

    def rib(self, at: Attachment, **further: object) -> Path:
        """Write ``rib.yaml`` of a RIB, below that of the tier above; return the file."""
        upper = self.topology.domain_of(at.switch).upper
        above = self.topology.rib_of(upper) if upper is not None else None
        name = self.name(Role.RIB, above.switch).to_text() if above is not None else None
        content = {**self.node_yaml(Role.RIB, at.switch), "iface": at.ifname, "upper": name}
        return self._write("rib", at.switch, {**content, **self._lease, **self._uplink, **further})

    def proxy(
        self, at: Attachment, carried: Mapping[Side, Sequence[Carried]], *, label: str | None = None, **further: object
    ) -> Path:
        """Give a proxy the rights of its sides, and write its ``proxy.yaml``; return the file."""
        label = label or at.switch
        rules: Yaml = {}
        for side, names in carried.items():
            rules[side] = [each.rule(self.owner_key) for each in names]
            for each in names:
                self.delegate(label, each.metadata, each.right(side))
        delegations = self.identity(Role.PROXY, label) / DELEGATIONS
        delegations.mkdir(mode=0o700, exist_ok=True)
        content = {
            **self.node_yaml(Role.PROXY, label, at.switch),
            "iface": at.ifname,
            "delegations": str(delegations),
            **self._lease,
            **self._uplink,
        }
        return self._write("proxy", label, {**content, **rules, **further})

    def delegate(self, label: str, metadata: Metadata, right: Right) -> Name:
        """Give a proxy or a member one right, which it may have already; return the name."""
        identity = self.identity(Role.PROXY, label)
        given = delegate(self.owner, identity / CARD, metadata, [right])
        install_delegation(identity, given, force=True)
        return given.name

    def write(self, name: str, content: Mapping[str, object]) -> Path:
        """Write a file of YAML; return its path."""
        path = self.folder / name
        path.write_text(yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True), encoding="utf-8")
        return path

    def _write(self, role: Literal["switch", "rib", "proxy"], label: str, content: Yaml) -> Path:
        metrics: Yaml = {"metrics": {"port": METRICS_PORTS[role]}} if self._has_metrics else {}
        return self.write(self.file(role, label).name, {**metrics, **content})


def grant(owner: Path, node: Path, rights: NameRights, types: Mapping[str, str] | None = None) -> None:
    """Let a node act on names; ``types``: ROS types of names."""
    (node / DELEGATIONS).mkdir(mode=0o700, exist_ok=True)
    for name, given in rights.items():
        type_name = (types or {}).get(name, "")
        calls = "action" if "/action/" in type_name else "service"
        kind = calls if {Right.SERVE, Right.CALL} & set(given) else "topic"
        typed = {"type": type_name} if type_name else {}
        metadata = Metadata({"kind": kind, "name": name, **typed})
        install_delegation(node, delegate(owner, node / CARD, metadata, list(given)))


def make_nodes(
    folder: Path,
    nodes: Mapping[str, Role],
    rights: Mapping[str, NameRights] | None = None,
    types: Mapping[str, str] | None = None,
) -> None:
    """Make ``folder/domain`` and ``folder/owner``, and the keys of nodes of that domain, without topology.

    ``nodes``: role by folder; the first folder of the path is the label. ``rights``: by node, as in ``grant``.
    """
    make_domain(folder / "domain", _DOMAIN)
    make_owner(folder / "owner")
    for path, role in nodes.items():
        make_node(folder / path, role, path.partition("/")[0], folder / "domain")
    for path, names in (rights or {}).items():
        grant(folder / "owner", folder / path, names, types)
