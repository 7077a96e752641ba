"""Files of a live proxy, as a program that adds rules to it needs them.

I/O. ``proxy.yaml`` is read and never changed; the program's own rules are one drop-in file. The proxy validates all
rules when it reloads. If it refuses them, the earlier drop-in is restored.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, TypeAlias

from gdp.config.drop_in import drop_in_directory, read_drop_in, write_drop_in
from gdp.config.offered_qos import OfferedQos
from gdp.config.yaml_source import Plain, YamlSource, read_yaml
from gdp.errors import ConfigError, LocalError
from gdp.intervals import RELOAD_S
from gdp.management.control_client import NotRunningError, ask_node, find_control_socket
from gdp.names import Name
from gdp.ros_names import is_name, matches, prefixed, unprefixed
from gdp.state.control_protocol import Command

Side: TypeAlias = Literal["expose", "import"]

DROP_IN: Final = "gdp-share.yaml"
_OTHER_FORMAT: Final = "the proxy reports its names in another format; restart it with this version"


@dataclass(frozen=True, slots=True, kw_only=True)
class StatedRule:
    """A rule that a person or another program wrote.

    Args:
        name: the name that all sides know, or a pattern of such.
        type_name: empty if the rule states none.
        metadata: whatever else the 256-bit name digests.
        is_salted: whether a file holds an unguessable part of the name.
        where: ``file:line:column`` of the rule.
    """

    side: Side
    kind: str
    name: str
    type_name: str
    metadata: Mapping[str, str | int]
    is_salted: bool
    where: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Undelegated:
    """A local name that a rule of the live proxy means, and for which the proxy holds no delegation.

    Args:
        local: its name in the graph.
        shared: the ROS name that all sides know, with the prefix of the machine.
        name: the 256-bit name that the rule gives to it.
        node: name or pattern of the rule of kind ``node`` that brings it; empty: a rule is about it.
    """

    side: str
    kind: str
    local: str
    shared: str
    type_name: str
    name: Name
    node: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveNames:
    """Names in the status of a live proxy: those that lack a delegation, and the QoS that exposed topics offer."""

    undelegated: Sequence[Undelegated] = ()
    qos: Mapping[Name, OfferedQos] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProxyFiles:
    """Paths and rules of one proxy.

    Args:
        root: root certificate of the proxy's domain.
        control_socket: None: at the default place.
        rules: of ``proxy.yaml`` and of the drop-ins of other programs.
        prefix: namespace of this machine on the overlay; empty: none.
        has_daily_epochs: whether names get a new epoch each day.
    """

    path: Path
    identity: Path
    root: Path
    delegations: Path
    control_socket: Path | None
    rules: Sequence[StatedRule]
    prefix: str = ""
    has_daily_epochs: bool = True

    @classmethod
    def read(cls, path: Path) -> ProxyFiles:
        """Read the configuration of a proxy.

        Raises:
            ConfigError: it is missing, is not YAML, or lacks the proxy's identity, domain or delegations.
        """
        source = read_yaml(path)
        data = source.data if isinstance(source.data, dict) else {}
        domain = data.get("domain")
        socket = data.get("control_socket")
        prefix = str(data.get("prefix") or "")
        files = [path, *sorted(each for each in drop_in_directory(path).glob("[!.]*.yaml") if each.name != DROP_IN)]
        return cls(
            path=path,
            identity=_path(source, "identity", data.get("identity")),
            root=_path(source, "domain", domain.get("root") if isinstance(domain, dict) else None),
            delegations=_path(source, "delegations", data.get("delegations")),
            control_socket=None if socket is None else _path(source, "control_socket", socket),
            rules=tuple(rule for file in files for rule in _rules(read_yaml(file), prefix)),
            prefix=prefix,
            has_daily_epochs=data.get("epochs") != "manual",
        )

    @property
    def drop_in(self) -> Path:
        """Return the file of this program's rules."""
        return drop_in_directory(self.path) / DROP_IN

    def shared_name(self, local: str) -> str:
        """Return the ROS name that all sides know for a name, or a pattern of names, of this machine."""
        return prefixed(self.prefix, local)

    def name_keys(self, shared: str) -> dict[str, str]:
        """Return the keys of a rule of this machine for a name that all sides know, or a pattern of such."""
        local = unprefixed(self.prefix, shared)
        return {"name": shared, "prefix": ""} if local is None else {"name": local}

    def find(self, side: Side, kind: str, name: str) -> StatedRule | None:
        """Return the rule that states exactly this name or pattern."""
        return next((each for each in self.rules if (each.side, each.kind, each.name) == (side, kind, name)), None)

    def replace_rules(self, text: str | None) -> bool:
        """Write this program's rules and reload the proxy; return whether it runs.

        Args:
            text: content of the drop-in; None: no rule is left.

        Raises:
            LocalError: the proxy refuses them, and the earlier rules are restored; or the file cannot be written.
        """
        before = read_drop_in(self.drop_in)
        if text != before:
            write_drop_in(self.path, DROP_IN, text)
        try:
            return self.reload()
        except LocalError:
            if text != before:
                write_drop_in(self.path, DROP_IN, before)
            raise

    def reload(self) -> bool:
        """Make the proxy read rules and delegations again; return whether it runs.

        Raises:
            LocalError: it keeps the old ones; the text gives its reason.
        """
        try:
            answer = ask_node(self._socket(), Command.RELOAD, RELOAD_S)
        except NotRunningError:
            return False
        if not answer.is_ok:
            raise LocalError(f"the proxy refused the change: {answer.error}")
        return True

    def live_names(self) -> LiveNames:
        """Return the names that the live proxy reports; none if it does not run.

        Raises:
            LocalError: it does not answer, or answers in another format.
        """
        try:
            answer = ask_node(self._socket(), Command.STATUS, RELOAD_S)
        except NotRunningError:
            return LiveNames()
        listed, qos = (answer.result.get(key, []) for key in ("undelegated", "qos"))
        if not isinstance(listed, list) or not isinstance(qos, list):
            raise LocalError(_OTHER_FORMAT)
        return LiveNames(undelegated=[_undelegated(each) for each in listed], qos=dict(map(_qos, qos)))

    def _socket(self) -> Path:
        return self.control_socket or find_control_socket(self.identity)


def fits(pattern: str, name: str) -> bool:
    """Return whether a full name, or a pattern of names, is the name or matches the pattern."""
    return pattern == name or matches(pattern, name)


def _undelegated(fields: object) -> Undelegated:
    match fields:
        case {
            "side": str(side), "kind": str(kind), "local": str(local), "shared": str(shared), "type": str(type_name),
            "name": str(name), **more,
        }:  # fmt: skip
            found, node = Name.from_text(name), str(more.get("node", ""))
            return Undelegated(
                side=side, kind=kind, local=local, shared=shared, type_name=type_name, name=found, node=node
            )
    raise LocalError(_OTHER_FORMAT)


def _qos(fields: object) -> tuple[Name, OfferedQos]:
    match fields:
        case {"name": str(name), **policies}:
            return Name.from_text(name), OfferedQos.from_fields({str(key): value for key, value in policies.items()})
    raise LocalError(_OTHER_FORMAT)


def _path(source: YamlSource, key: str, value: Plain) -> Path:
    if not isinstance(value, str):
        raise source.error((key,), "expected the configuration of a proxy, with identity, domain and delegations")
    try:
        return source.path.parent / Path(value).expanduser()
    except RuntimeError as error:
        raise ConfigError(str(source.path), key, str(error)) from error


def _rules(source: YamlSource, prefix: str) -> Iterator[StatedRule]:
    """Yield the rules of a file, without validation: the proxy itself validates them."""
    sides: tuple[Side, Side] = ("expose", "import")
    for side in sides:
        listed = source.data.get(side) if isinstance(source.data, dict) else None
        for index, rule in enumerate(listed if isinstance(listed, list) else []):
            if isinstance(rule, dict) and isinstance(name := rule.get("name"), str):
                line, column = source.values[side, index]
                more, own = rule.get("metadata"), rule.get("prefix")
                items = more.items() if isinstance(more, dict) else ()
                yield StatedRule(
                    side=side,
                    kind=str(rule.get("kind", "topic")),
                    name=prefixed(prefix if own is None else str(own), name),
                    type_name=str(rule.get("type") or "") if is_name(name) else "",
                    metadata={key: value for key, value in items if isinstance(value, str | int)},
                    is_salted=rule.get("salt_file") is not None,
                    where=f"{source.path}:{line}:{column}",
                )
