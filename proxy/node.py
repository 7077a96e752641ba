"""A proxy at work: a member of the overlay on one device, with the topics that its configuration makes global.

Place: shell.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from gdp.client.member import Member, Topic
from gdp.control.settings import NodeSettings
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.errors import GdpError, LocalError
from gdp.names import Name
from gdp.nodes.membership import incarnation, load_member, wall_clock_ms
from gdp.nodes.runtime import Runtime
from gdp.nodes.switch import count_list
from gdp.ports.plane import Plane
from gdp.ports.raw import RawPlane
from gdp.stores.keyring import load_delegations
from gdp.telemetry.metrics import Histogram, Metrics, Sources
from gdp.trust.delegation import Delegation
from proxy.config import ProxyConfig, Rule

__all__ = ["ProxyNode", "open_topics", "run_node"]

log = logging.getLogger(__name__)


@dataclass(slots=True)
class ProxyNode:
    """What runs, for the command that drives it."""

    member: Member
    runtime: Runtime
    plane: Plane
    topics: Mapping[Name, Topic]
    latency: Histogram
    messages_out: int = 0
    bytes_out: int = 0
    messages_in: int = 0
    bytes_in: int = 0

    def linger(self, duration_s: float) -> None:
        """Work on for a while, so that a goodbye is heard."""
        self.runtime.run(lambda: False, time.monotonic() + duration_s)

    def sources(self) -> Sources:
        """Return what the metrics show."""
        counters, member = self.plane.counters, self.member
        return Sources(
            frames=lambda: {"in": counters.frames_in, "out": counters.frames_out},
            drops=[lambda: counters.drops, lambda: count_list(member.drops())],
            messages=lambda: {"in": self.messages_in, "out": self.messages_out},
            message_bytes=lambda: {"in": self.bytes_in, "out": self.bytes_out},
            repairs=lambda: {"sent": sum(publisher.repairs for publisher in member.publishers())},
            latency=lambda: self.latency,
        )


@contextlib.contextmanager
def run_node(config: ProxyConfig) -> Iterator[ProxyNode]:
    """Open everything that a proxy needs; close it on leaving.

    Raises:
        LocalError: keys, delegations or the device are not as the configuration says.
    """
    identity, policy = load_member(config.identity, config.domain, Role.PROXY)
    topics = open_topics(config, identity)
    settings = NodeSettings(incarnation(), wall_clock_ms(), secrets.token_bytes)
    member = Member(identity, policy, settings)
    with contextlib.ExitStack() as stack:
        plane = RawPlane([config.iface])
        stack.callback(plane.close)
        runtime = Runtime(member, plane, spin_s=config.spin_us / 1e6)
        stack.enter_context(runtime.signals(lambda: _renew(config, identity, member)))
        node = ProxyNode(member, runtime, plane, topics, Histogram())
        if config.metrics is not None:
            metrics = Metrics(node.sources())
            metrics.serve(config.metrics.port)
            stack.callback(metrics.close)
        log.info("proxy up name=%s iface=%s topics=%d", identity.name.short, config.iface, len(topics))
        yield node


def open_topics(config: ProxyConfig, identity: Identity) -> dict[Name, Topic]:
    """Return, for every rule, what this node may do with its name, verified, and the topic's secrets.

    Raises:
        LocalError: a rule without a delegation that holds.
    """
    held = {delegation.name: delegation for delegation in load_delegations(config.delegations)}
    topics: dict[Name, Topic] = {}
    for rule in [*config.expose, *config.imports]:
        delegation = held.get(rule.overlay_name)
        if delegation is None:
            raise LocalError(
                f"{rule.name}: no delegation for {rule.overlay_name.to_text()} in {config.delegations};"
                " the owner makes one with 'gdp delegate'"
            )
        topics[rule.overlay_name] = _open(rule, delegation, identity)
    return topics


def _renew(config: ProxyConfig, identity: Identity, member: Member) -> None:
    """Read the delegations anew: new epochs and longer validity take effect without a message lost."""
    try:
        topics = open_topics(config, identity)
    except GdpError as error:
        log.error("delegations not renewed reason=%s", error)
        return
    for topic in topics.values():
        member.renew(topic)
    log.info("delegations renewed topics=%d", len(topics))


def _open(rule: Rule, delegation: Delegation, identity: Identity) -> Topic:
    delegation.verify(identity, time.time())
    secrets_by_epoch = {epoch: grant.secret for epoch, grant in delegation.open(identity).items()}
    if not secrets_by_epoch:
        raise LocalError(f"{rule.name}: the delegation holds no secret of any epoch")
    return Topic(delegation, secrets_by_epoch)
