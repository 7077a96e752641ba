"""Bridge between one recording and the overlay.

I/O. ``gdp-replay`` and a ``gdp-proxy`` without a graph drive it.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator
from dataclasses import replace

from gdp.nodes.delegation_store import DelegationStore
from proxy.bridge.bridge import Bridge
from proxy.config.config import ProxyConfig
from proxy.config.recorded import RecordedRules
from proxy.node.node import ProxyNode, open_topics
from proxy.node.state_answer import answer_for_proxy
from proxy.recordings.endpoint import RecordingEndpoint, ReplayEndpoint

log = logging.getLogger(__name__)


@contextlib.contextmanager
def open_recording_bridge(
    node: ProxyNode, settings: ProxyConfig, rules: RecordedRules, endpoint: ReplayEndpoint | RecordingEndpoint
) -> Iterator[Bridge]:
    """Begin every flow between a recording and the overlay; after a SIGHUP delegations are read again.

    Raises:
        LocalError: a rule of ``settings`` has no valid delegation, or a topic cannot be published.
    """
    held = DelegationStore(settings.delegations, node.identity)
    open_topics(settings, held)
    node.state.context = replace(node.state.context, keeper=node.open_keeper(settings, held))
    node.state.bridge = bridge = Bridge(node.state.context, rules, [endpoint], held)
    answer_for_proxy(node.state, bridge)
    node.on_reload = lambda: _renew(node, settings, rules, bridge)
    node.runtime.watch(endpoint)
    try:
        while not bridge.is_settled:  # the first pass reads the graph, later ones the descriptions
            node.work(bridge)
        node.work(bridge)
        yield bridge
    finally:
        node.on_reload = None
        node.runtime.unwatch(endpoint)
        endpoint.shut_down()
        if node.state.context.keeper is not None:
            node.state.context.keeper.capsules.close(time.time())


def _renew(node: ProxyNode, settings: ProxyConfig, rules: RecordedRules, bridge: Bridge) -> None:
    """Read the delegations again: new epochs and longer validity take effect without losing a message."""
    held = DelegationStore(settings.delegations, node.identity)
    topics = open_topics(settings, held)
    bridge.reload(rules, held)
    log.info("delegations renewed topics=%d", len(topics))
