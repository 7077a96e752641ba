"""Member that a tool runs as: a node whose delegation gives the right that the tool needs, for as long as it works."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from gdp.client.participant import Topic
from gdp.crypto.certificates import Role
from gdp.errors import LocalError
from gdp.intervals import ATTACH_S
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore
from gdp.nodes.membership import load_member
from gdp.stores.keyring import CARD
from gdp.trust.right import Right
from proxy.bridge.bridge import Bridge
from proxy.bridge.core.delegated_rules import DelegatedRules, rules_of
from proxy.config.config import ProxyConfig
from proxy.config.rule import Rule
from proxy.endpoints.probe import Probe
from proxy.node.member_config import member_config
from proxy.node.node import run_node

_ELLIPSIS: Final = ("…", "...")
_HEX: Final = set("0123456789abcdef")

Tick = Callable[[Bridge, float], "float | None"]  # at a monotonic second; returns the next one, or None to end


class NoAnswerError(LocalError):
    """What the tool waited for did not come in time."""


class Wanted(NamedTuple):
    """Name that the user typed.

    Attributes:
        text: a ROS name, 64 hex digits, or the short form that logs print, such as ``75e…0fc``.
        type_name: to choose among names of several types; empty: any.
        right: READ of a topic, CALL of a service.
    """

    text: str
    type_name: str
    right: Right

    @property
    def kind(self) -> str:
        """Return ``topic`` or ``service``."""
        return "topic" if self.right is Right.READ else "service"

    def fits(self, topic: Topic) -> bool:
        """Return whether a delegation is about the name."""
        metadata = dict(topic.delegation.metadata or {})
        if self.type_name and metadata.get("type", self.type_name) != self.type_name:
            return False
        if is_overlay_name(self.text):
            return topic.name == Name.from_text(self.text)
        if (ends := short_ends(self.text)) is not None:
            return topic.name.hex().startswith(ends[0]) and topic.name.hex().endswith(ends[1])
        return metadata.get("name") == self.text and metadata.get("kind") == self.kind


@dataclass(frozen=True, slots=True)
class Access:
    """A member's access to one name: its configuration, the delegations, and the rule of that name."""

    config: ProxyConfig
    held: DelegationStore
    name: Name
    rule: Rule


def is_overlay_name(text: str) -> bool:
    """Return whether a text is a 256-bit name in hex."""
    return len(text) == 64 and set(text.lower()) <= _HEX


def short_ends(text: str) -> tuple[str, str] | None:
    """Return both ends of a name's short form, in lower case; None: the text is no such form."""
    for dots in _ELLIPSIS:
        first, found, last = text.lower().partition(dots)
        if found and first and last and set(first + last) <= _HEX:
            return first, last
    return None


def find_access(node: Path, iface: str | None, delegations: Path | None, wanted: Wanted) -> Access:
    """Return a node's access to a name.

    Args:
        node: its directory, or its configuration file.

    Raises:
        LocalError: the node does not exist or lacks the right, which the text says how to get; or several names fit.
    """
    config, directory = member_config(node, iface, delegations)
    identity, _ = load_member(config.identity, config.domain, Role.PROXY)
    held = DelegationStore(directory, identity)
    found = [topic for topic in held if wanted.fits(topic)]
    allowed = [topic for topic in found if wanted.right in topic.delegation.rights]
    if not allowed:
        raise LocalError(_no_right(node, config.identity / CARD, wanted, found))
    if len(allowed) > 1:
        lines = "".join(f"\n  {topic.name.to_text()}  {_meaning(topic)}" for topic in allowed)
        raise LocalError(f"{wanted.text}: {len(allowed)} names fit; state --type, or one of them in hex:{lines}")
    topic = allowed[0]
    rules = rules_of([topic])
    rule = next((each for each in rules.imports if each.kind == wanted.kind), None)
    if rule is None:
        reason = rules.left_out[0][1] if rules.left_out else f"it is no {wanted.kind}"
        raise LocalError(f"{wanted.text}: the delegation in {directory} cannot be used: {reason}")
    return Access(config, held, topic.name, rule)


def run_probe(access: Access, probe: Probe, tick: Tick, *, timeout_s: float | None = None) -> None:
    """Run the member until ``tick`` returns None, or a signal ends it.

    Args:
        tick: called after each step from the attachment on, and at the second that it returned.
        timeout_s: of each call of the service; None: as the rule says.

    Raises:
        NoAnswerError: no switch accepted the member within ``ATTACH_S``.
        LocalError: keys or the device are not as stated, or this node runs already.
    """
    rule = access.rule if timeout_s is None else access.rule.model_copy(update={"timeout_s": timeout_s})
    with run_node(access.config) as node:
        state, bridge = node.state, Bridge(node.state.context, DelegatedRules((), [rule]), [probe], access.held)
        state.bridge, state.shows_held = bridge, False
        node.on_reload = lambda: bridge.reload(
            DelegatedRules((), [rule]), DelegationStore(access.held.directory, node.identity)
        )
        node.runtime.watch(probe)
        attach_by_s = time.monotonic() + ATTACH_S
        tick_at_s: float | None = attach_by_s
        try:
            while not node.runtime.is_stopped and tick_at_s is not None:
                now_s = node.step(bridge, tick_at_s)
                if node.member.attachment.is_attached:
                    tick_at_s = tick(bridge, now_s)
                elif now_s >= attach_by_s:
                    waits = "; ".join(node.node_log.waiting_for(now_s)) or "no switch has answered"
                    raise NoAnswerError(f"not attached on {access.config.iface} within {ATTACH_S:g} s: {waits}")
        finally:
            node.runtime.unwatch(probe)
            node.say_goodbye(bridge)
            probe.shut_down()


def names_held(node: Path, right: Right) -> Iterator[str]:
    """Yield the ROS names for which a node has a right, for completion.

    Raises:
        GdpError: the node cannot be read.
    """
    config, directory = member_config(node, None, None)
    identity, _ = load_member(config.identity, config.domain, Role.PROXY)
    for metadata, _ in DelegationStore(directory, identity).described(right):
        yield str(metadata["name"])


def _no_right(node: Path, card: Path, wanted: Wanted, found: list[Topic]) -> str:
    """Return that the node lacks the right, with the commands that give it."""
    metadata = next((topic.delegation.metadata for topic in found if topic.delegation.metadata is not None), None)
    name = "NAME" if is_overlay_name(wanted.text) or short_ends(wanted.text) else wanted.text
    type_name = wanted.type_name or "TYPE"
    more = ""
    if metadata is not None:
        name, type_name = str(metadata["name"]), str(metadata.get("type", type_name))
        others = {key: value for key, value in metadata.items() if key not in ("kind", "name", "type", "salt")}
        more = "".join(f" --meta {shlex.quote(f'{key}={value}')}" for key, value in others.items())
        more += " --salt-file FILE" if "salt" in metadata else ""
    file = f"{name.strip('/').replace('/', '_')}.delegation"
    verb = wanted.right.value
    return (
        f"{wanted.text}: node {node} has no right to {verb} it. The owner types, and gives you the file:\n"
        f"  gdp delegate name --owner OWNER --card {shlex.quote(str(card))} --right {verb} --kind {wanted.kind}"
        f" --name {name} --type {type_name}{more} --out {file}\n"
        f"Then type: gdp delegate install {file} --node {shlex.quote(str(node))}"
    )


def _meaning(topic: Topic) -> str:
    metadata = topic.delegation.metadata
    return "not described" if metadata is None else f"{metadata['name']} [{metadata.get('type', '?')}]"
