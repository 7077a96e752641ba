"""Counters of messages and calls of proxies on this host, for idle limits and scaling of clusters.

I/O. The counters come from the control socket of a proxy. If the socket of a robot's proxy cannot be reached, as in a
container, its metrics port is queried. The count includes topics, so it is never less than the number of calls.
Source: Prometheus text exposition format, version 0.0.4.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from http.client import HTTPException
from pathlib import Path
from typing import Final
from urllib.request import urlopen

from fog.bootstrap.robot_config import control_socket_of
from fog.scaling import CallCounts
from gdp.errors import GdpError
from gdp.intervals import PROMPT_S
from gdp.management.control_client import ask_node, find_control_socket_of
from gdp.names import Name
from gdp.state.control_protocol import Command
from proxy.config.config import ProxyConfig

_SENT: Final = re.compile(rb'^gdp_messages_total\{direction="out"\} (\S+)$', re.MULTILINE)


def received_by(proxy: str) -> int | None:
    """Return the messages received by a machine's proxy on this host since its start; None: no response.

    Args:
        proxy: its name, 64 hex digits.
    """
    try:
        return _count(find_control_socket_of(Name.from_text(proxy)), "in")
    except GdpError:
        return None


def sent_by(proxy: Path) -> int | None:
    """Return the messages sent by a robot's proxy since its start; None: no response.

    Args:
        proxy: its ``proxy.yaml``.

    Raises:
        ConfigError: the file is not a proxy configuration.
    """
    config = ProxyConfig.load(proxy)
    try:
        return _count(control_socket_of(config.identity, config.control_socket), "out")
    except GdpError:
        return None if config.metrics is None else _sent_by_metrics(config.metrics.port)


def calls_of(proxy: Path, services: Collection[str]) -> CallCounts | None:
    """Return the answered calls of a robot's proxy since its start; None: no response.

    Args:
        proxy: its ``proxy.yaml``.
        services: overlay names of the services that count, 64 hex digits each.

    Raises:
        ConfigError: the file is not a proxy configuration.
    """
    config = ProxyConfig.load(proxy)
    try:
        socket = control_socket_of(config.identity, config.control_socket)
        match ask_node(socket, Command.STATUS, PROMPT_S).result:
            case {"calls": dict(calls)}:
                counts = [_answered(calls[name]) for name in services if name in calls]
                return CallCounts(sum(each.ended for each in counts), sum(each.total_ms for each in counts))
    except GdpError:
        return None
    return None  # of an earlier version


def _answered(fields: object) -> CallCounts:
    match fields:
        case {"ended": int(ended), "total_ms": int() | float() as total_ms}:
            return CallCounts(ended, float(total_ms))
    return CallCounts(0, 0.0)


def _count(socket: Path, direction: str) -> int | None:
    match ask_node(socket, Command.STATUS, PROMPT_S).result:
        case {"counters": {"messages": dict(messages)}} if isinstance(messages.get(direction), int):
            return int(messages[direction])
    return None


def _sent_by_metrics(port: int) -> int | None:
    try:
        with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PROMPT_S) as answer:
            found = _SENT.search(answer.read())
    except (OSError, HTTPException):
        return None  # it does not run, or runs on another host
    return None if found is None else int(float(found[1]))
