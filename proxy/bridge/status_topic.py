"""Status topic: a latched local ``std_msgs/msg/String`` with the parties of all carried names as JSON.

I/O through an endpoint. It is published when something changes, at most a few times a second.
"""

from __future__ import annotations

import json
import logging
import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from gdp.errors import LocalError
from gdp.intervals import WATCH_S
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.liveliness import LivelinessTracker, NameLiveliness
from proxy.config.status_topic import StatusTopicConfig
from proxy.endpoints.core.endpoint import EndpointError, Event
from proxy.endpoints.core.qos import default
from proxy.serial.channel import RosVersion

log = logging.getLogger(__name__)

_STRING: Final = "std_msgs/msg/String"
_CDR: Final = b"\0\1\0\0"
_LENGTH: Final = struct.Struct("<I")


class StatusTopic:
    """The status topic in one graph.

    Raises:
        LocalError: the graph knows no ``std_msgs/msg/String``, or a node has the topic with another type.
    """

    def __init__(self, dispatcher: EndpointDispatcher, settings: StatusTopicConfig) -> None:
        self._dispatcher = dispatcher
        self._tracker = LivelinessTracker(settings.deadline_s)
        self._due_s = 0.0
        self._published = ""
        channel = dispatcher.endpoint.channel(settings.topic, _STRING)
        qos = (default(latched=True, depth=1),)
        self._handle = dispatcher.advertise(self, replace(channel, topic=settings.topic, qos=qos, latched=True))

    def is_due(self, now_s: float) -> bool:
        """Return whether the names are to be observed."""
        return now_s >= self._due_s

    def update(self, names: Sequence[NameLiveliness], now_s: float) -> None:
        """Take an observation, and publish it if it differs from the last one."""
        self._due_s = now_s + WATCH_S
        self._tracker.update(names, now_s)
        text = json.dumps({"names": [self._fields(each) for each in names]}, ensure_ascii=False)
        if text != self._published:
            self._published = text
            self._dispatcher.endpoint.publish(self._handle, string_message(text, self._dispatcher.endpoint.ros))

    def handle_event(self, event: Event, now_s: float) -> None:
        """Report a fault of the topic."""
        del now_s
        if isinstance(event, EndpointError):
            log.warning("no status topic reason=%s", event.reason)

    def close(self) -> None:
        """Close the topic."""
        self._dispatcher.close(self._handle)

    def _fields(self, name: NameLiveliness) -> dict[str, object]:
        """Return the JSON form without times, which change with every message."""
        parties = [
            {"role": each.role, "node": each.node, "silent": self._tracker.is_silent(name, each), **each.control}
            for each in sorted(name.parties, key=lambda each: (each.role, each.node))
        ]
        return {**name.to_fields(), "parties": parties}


def open_status_topics(dispatchers: Sequence[EndpointDispatcher], settings: StatusTopicConfig) -> list[StatusTopic]:
    """Open the status topic in each graph; a graph that refuses it is reported and left out."""
    opened = []
    for dispatcher in dispatchers:
        try:
            opened.append(StatusTopic(dispatcher, settings))
        except LocalError as error:
            log.warning("no status topic endpoint=%s reason=%s", dispatcher.endpoint.label, error)
    return opened


def string_message(text: str, ros: RosVersion) -> bytes:
    """Return a ``std_msgs/msg/String`` in the wire form of a ROS."""
    data = text.encode()
    if ros == 1:
        return _LENGTH.pack(len(data)) + data
    return _CDR + _LENGTH.pack(len(data) + 1) + data + b"\0"
