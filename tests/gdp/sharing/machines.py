"""Machines that share names: files as ``gdp lab`` makes them, a proxy that reloads, and an exchange in memory."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from gdp.config.offered_qos import OfferedQos
from gdp.crypto.certificates import Role
from gdp.errors import LocalError, StoreError
from gdp.management.control_socket import ControlHandlers, serve_control_in_thread
from gdp.names import Name
from gdp.ros_names import Interface
from gdp.sharing.exchange import Mail
from gdp.sharing.sharing import Sharing
from gdp.sharing.state import AcceptedName, ExposedName
from gdp.stores.issue import make_domain, make_node, make_owner
from gdp.stores.keyring import CARD, OWNER_PUBLIC, load_card, load_delegations, load_owner
from gdp.trust.delegation import Delegation
from gdp.trust.node_descriptor import NodeDescriptor
from proxy.config.brought_rule import BroughtRule
from proxy.config.config import ProxyConfig
from proxy.config.matching import choose

DAY_S: Final = 86_400
IMAGE: Final = "sensor_msgs/msg/Image"
STRING: Final = "std_msgs/msg/String"
PLAN: Final = "nav_msgs/srv/GetPlan"
_PROXY: Final = """\
identity: proxy
domain: {root: proxy/root.crt}
delegations: proxy/delegations
iface: proxy0
control_socket: control.sock
ros: {endpoint: ros2, domain: 0}
"""


class Directory:
    """Exchange of all machines of a test, in memory; ``is_down``: no call is answered."""

    def __init__(self) -> None:
        self.is_down = False
        self.cards: dict[str, NodeDescriptor] = {}
        self.mail = defaultdict[Name, list[Mail]](list)

    def of(self, label: str) -> _Member:
        """Return the exchange as one machine uses it."""
        return _Member(self, label)


@dataclass(slots=True)
class _Member:
    directory: Directory
    label: str

    def nodes(self) -> Sequence[NodeDescriptor]:
        self._check()
        return list(self.directory.cards.values())

    def send(self, to: Name, kind: str, data: bytes) -> None:
        self._check()
        self.directory.mail[to].append(Mail(sender=self.label, kind=kind, data=data))

    def receive_mail(self) -> Iterator[Mail]:
        self._check()
        waiting = self.directory.mail[self.directory.cards[self.label].name]
        while waiting:
            yield waiting[0]
            waiting.pop(0)

    def _check(self) -> None:
        if self.directory.is_down:
            raise StoreError("the domain's server does not answer")


@dataclass(slots=True)
class Machine:
    """One machine; ``start`` runs its proxy.

    Attributes:
        graph: what its local nodes publish or serve: kind, name and type.
        brought: what nodes have: node, side on which it goes, kind, name and type.
        qos: of local topics, by name.
        reloads: how often the proxy has reloaded.
        refusal: why the proxy refuses to reload, empty: it validates the files.
    """

    label: str
    folder: Path
    directory: Directory
    graph: list[tuple[str, str, str]] = field(default_factory=list)
    brought: list[tuple[str, str, Interface, str, str]] = field(default_factory=list)
    qos: dict[str, OfferedQos] = field(default_factory=dict)
    reloads: int = 0
    refusal: str = ""
    config: ProxyConfig | None = None

    @property
    def path(self) -> Path:
        """Return ``proxy.yaml``."""
        return self.folder / "proxy.yaml"

    @property
    def owner(self) -> Path:
        """Return the directory of its owner key."""
        return self.folder / "owner"

    @property
    def sharing(self) -> Sharing:
        """Return what the command uses."""
        return Sharing(self.path, self.directory.of(self.label), [self.owner])

    @property
    def held(self) -> list[Delegation]:
        """Return the delegations that its proxy has."""
        return load_delegations(self.folder / "proxy" / "delegations")

    def rules(self, side: str) -> list[tuple[str, str]]:
        """Return name and type of the rules on one side, as the proxy reads the files."""
        config = ProxyConfig.load(self.path)
        return [(rule.name, rule.type_name) for rule in (config.expose if side == "expose" else config.imports)]

    def rights(self) -> dict[str, set[str]]:
        """Return the rights that its proxy has, by ROS name."""
        return {_ros_name(each): {right.value for right in each.rights} for each in self.held}

    def exposing(
        self, name: str, *to: str, type_name: str = "", kind: str = "topic", days: float = 30, **options: object
    ) -> ExposedName:
        """Return a name to expose under the machine's owner key."""
        key = load_owner(self.owner).public.compressed.hex()
        fields = {"kind": kind, "name": name, "type_name": type_name, "to": to, "owner": self.owner, **options}
        return ExposedName.model_validate({**fields, "owner_key": key, "days": days})

    def start(self, stack: ExitStack) -> None:
        """Run the proxy until the stack closes."""
        self.config = ProxyConfig.load(self.path)
        handlers = ControlHandlers(reload=self._reload, status=self._status, drain=lambda: None)
        stack.enter_context(serve_control_in_thread(self.folder / "control.sock", handlers))

    def _reload(self) -> None:
        if self.refusal:
            raise LocalError(self.refusal)
        self.config = ProxyConfig.load(self.path)
        self.reloads += 1

    def _status(self) -> dict[str, object]:
        held = {each.name for each in self.held}
        listed, qos = [], []
        for kind, local, type_name in self.graph:
            rules = self.config.expose if self.config is not None else ()
            rule = next((each for each in rules if each.kind == kind == "node" and each.name == local), None)
            rule = rule or choose(rules, kind, local, type_name)  # type: ignore[arg-type]
            name = None if rule is None else rule.overlay_name_of(local, type_name)
            if name is not None and local in self.qos:
                qos.append({"name": name.to_text(), **self.qos[local].model_dump()})
            if name is not None and name not in held:
                shared = local if rule is None else rule.global_name_of(local)
                fields = {"side": "expose", "kind": kind, "local": local, "shared": shared, "type": type_name}
                listed.append({**fields, "name": name.to_text()})
        rules = () if self.config is None else (*self.config.expose, *self.config.imports)
        for node, side, kind, local, type_name in self.brought:
            of_pattern = next((each for each in rules if each.kind == "node" and each.name == node), None)
            if (rule := of_pattern or choose(rules, "node", node)) is not None:
                name = BroughtRule.by(rule).of(kind, local, type_name).overlay_name_of(local, type_name)
                fields = {
                    "side": side,
                    "kind": kind,
                    "local": local,
                    "shared": local,
                    "type": type_name,
                    "node": rule.name,
                }
                listed += [] if name in held else [{**fields, "name": name.to_text()}]
        return {"undelegated": listed, "qos": qos}


@dataclass(slots=True)
class Site:
    """Machines of one domain.

    Attributes:
        now_s: virtual wall clock, Unix seconds.
    """

    folder: Path
    directory: Directory = field(default_factory=Directory)
    machines: dict[str, Machine] = field(default_factory=dict)
    now_s: float = field(default_factory=time.time)

    def __post_init__(self) -> None:
        make_domain(self.folder / "lab", "lab", unix_s=self.now_s)

    def add(self, label: str, rules: str = "", *, is_salted: bool = True) -> Machine:
        """Add a machine with an owner key; ``rules`` are appended to its ``proxy.yaml``."""
        folder = self.folder / label
        make_node(folder / "proxy", Role.PROXY, label, self.folder / "lab", unix_s=self.now_s)
        (folder / "proxy" / "delegations").mkdir(mode=0o700)
        owner = make_owner(folder / "owner", is_salted=is_salted)
        (folder / OWNER_PUBLIC).write_bytes(owner.public.to_pem())
        (folder / "proxy.yaml").write_text(_PROXY + rules)
        self.directory.cards[label] = load_card(folder / "proxy" / CARD)
        self.machines[label] = Machine(label, folder, self.directory)
        return self.machines[label]

    def upkeep(self) -> list[str]:
        """Run the upkeep of each machine once; return the problems."""
        return [text for each in self.machines.values() for text in each.sharing.work(self.now_s).problems]


def importing(name: str, source: str | None = None) -> AcceptedName:
    """Return a name to import."""
    return AcceptedName(side="import", name=name, source=source)


def _ros_name(delegation: Delegation) -> str:
    return str(dict(delegation.metadata or {}).get("name"))
