"""Node of a door: an ordinary member of the overlay, whose bridge carries what its delegations allow."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable

from gdp.cli.node import emit, emit_wait, report
from gdp.intervals import TICK_S, TURN_S
from gdp.nodes.delegation_store import DelegationStore
from gdp.terminal import echo
from gdp_extensions.doors.endpoint import DoorEndpoint
from proxy.bridge.bridge import Bridge
from proxy.bridge.core.delegated_rules import DelegatedRules, rules_of
from proxy.config.config import ProxyConfig
from proxy.node.node import ProxyNode, run_node

log = logging.getLogger(__name__)

OpenDoor = Callable[[Callable[[], DelegatedRules]], DoorEndpoint]


def run_door(config: ProxyConfig, open_door: OpenDoor, *, json: bool) -> None:
    """Serve clients until stopped; SIGHUP or ``gdp reload`` reads the delegations again.

    Raises:
        LocalError: keys, delegations, the device or the address are not as stated.
    """
    sys.setswitchinterval(TURN_S)
    with run_node(config, emit_wait if json else None) as node:
        held = DelegationStore(config.delegations, node.identity)
        state = [rules_of(list(held))]
        for name, reason in state[0].left_out:
            log.warning("delegation not offered name=%s reason=%s", name, reason)
        door = open_door(lambda: state[0])
        try:
            node.state.bridge = bridge = Bridge(node.state.context, state[0], [door], held)

            def reload() -> None:
                again = DelegationStore(config.delegations, node.identity)
                state[0] = rules_of(list(again))
                bridge.reload(state[0], again)

            node.on_reload = reload
            node.runtime.watch(door)
            try:
                _work(node, bridge, door, state, json=json)
            finally:
                node.runtime.unwatch(door)
            node.say_goodbye(bridge)
        finally:
            door.shut_down()
        traffic = node.state.context.traffic
        totals = {"sent": traffic.messages_out, "received": traffic.messages_in, "dropped": door.dropped}
        text = "{received} messages read, {sent} published, {dropped} dropped for slow clients".format(**totals)
        report("done", text, json=json, **totals, faults=dict(node.state.context.faults.counts))


def _work(node: ProxyNode, bridge: Bridge, door: DoorEndpoint, state: list[DelegatedRules], *, json: bool) -> None:
    is_ready = False
    tick_at_s = 0.0
    while not node.runtime.is_stopped:
        now_s = node.step(bridge, tick_at_s)
        if now_s >= tick_at_s:
            tick_at_s = now_s + TICK_S
        if not is_ready and node.member.attachment.is_attached and bridge.is_settled:
            is_ready = True
            node.tell_refusals()
            _tell_ready(node, door, state[0], json=json)


def _tell_ready(node: ProxyNode, door: DoorEndpoint, rules: DelegatedRules, *, json: bool) -> None:
    if json:
        host, port = door.address
        reads, writes = [each.name for each in rules.imports], [each.name for each in rules.expose]
        emit(
            "ready", name=node.member.name.to_text(), host=host, port=port, url=door.url, reads=reads, publishes=writes
        )
        return
    echo(f"door {node.member.name.short} is attached, at {door.url}; Ctrl-C ends it")
    for verb, listed in (("offers", rules.imports), ("takes", rules.expose)):
        for rule in listed:
            echo(f"  {verb} {rule.kind} {rule.name} [{rule.type_name}]")
