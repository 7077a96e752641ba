"""Services by which local nodes take, give and look at the control of a topic: ``std_srvs/srv/Trigger``.

I/O through the endpoint and the participant. Each call asks the topic's readers as ``gdp control`` does: first who
holds control, then, with the generation that each has stated, to take or give it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Final

from gdp.control.diagnostics import Reply
from gdp.control.topic_control import ASK, NO_ANSWER, NO_READER, REPLY_BYTES, SHOW, has_control, request
from gdp.errors import LocalError
from gdp.intervals import ANSWER_S
from gdp.names import Name
from gdp.printable import printable
from gdp.sansio import Timestamps
from proxy.bridge.cancellation import TRIGGER
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.faults import Fault
from proxy.bridge.status_topic import string_message
from proxy.endpoints.core.endpoint import EndpointError, Event, RequestReceived
from proxy.serial.channel import RosVersion

log = logging.getLogger(__name__)

_CDR_BYTES: Final = 4  # encapsulation; a boolean before a length has three bytes of padding

_Replies = Mapping[Name, Reply | None]


class ControlServices:
    """The services of one topic, ``TOPIC/control/ACT``; a graph that refuses them is reported and has none.

    Args:
        readers: returns those that may have the topic under exclusive control.
        acts: of ``take``, ``give`` and ``show``; the last succeeds where this proxy holds control at every reader.
    """

    def __init__(
        self,
        context: BridgeContext,
        dispatcher: EndpointDispatcher,
        flow_spec: FlowSpec,
        readers: Callable[[], Collection[Name]],
        *acts: str,
    ) -> None:
        self._context = context
        self._dispatcher = dispatcher
        self._flow_spec = flow_spec
        self._readers = readers
        self._acts: dict[int, str] = {}  # by handle
        try:
            for act in acts:
                known = dispatcher.endpoint.service(f"{flow_spec.local}/control/{act}", TRIGGER)
                self._acts[dispatcher.serve(self, known)] = act
        except LocalError as error:
            context.faults.report(flow_spec.local, Fault.UNKNOWN_TYPE, f"no services for its control: {error}")

    def handle_event(self, event: Event, now_s: float) -> None:
        """Begin to answer a request."""
        if isinstance(event, EndpointError):
            self._context.report_error(self._flow_spec.local, event, Fault.REFUSED)
        elif isinstance(event, RequestReceived):
            self._ask({reader: {} for reader in self._readers()}, now_s, partial(self._act, event))

    def close(self) -> None:
        """Close the services; requests under way get no answer. Idempotent."""
        for handle in self._acts:
            self._dispatcher.close(handle)
        self._acts = {}

    def _ask(
        self, bodies: Mapping[Name, Mapping[str, object]], now_s: float, done: Callable[[_Replies, float], None]
    ) -> None:
        """Ask each reader; ``done`` gets all replies, and the monotonic second of the last one."""
        replies: dict[Name, Reply | None] = {}
        now = Timestamps(now_s, time.time())

        def take(reader: Name, reply: Reply | None, took_s: float) -> None:
            replies[reader] = reply
            if len(replies) == len(bodies):
                done(replies, now_s + took_s)

        if not bodies:
            done({}, now_s)
        for reader, body in bodies.items():
            on_reply = partial(take, reader)
            try:
                self._context.member.diagnostics.ask(
                    reader, ASK, now=now, on_reply=on_reply, name=self._flow_spec.name, body=body, timeout_s=ANSWER_S,
                    reply_bytes=REPLY_BYTES,
                )  # fmt: skip
            except LocalError as error:
                log.warning("a reader is not asked for control reader=%s reason=%s", reader.short, error)
                take(reader, None, 0.0)

    def _act(self, event: RequestReceived, replies: _Replies, now_s: float) -> None:
        """Ask the readers that have the topic under control to act on what they have said."""
        act = self._acts.get(event.handle, SHOW)
        found = {reader: reply for reader, reply in replies.items() if reply and has_control(reply.result)}
        if act == SHOW or not found:
            self._respond(event, found, now_s)
            return
        at = time.time_ns()
        bodies = {reader: request(act, reply.result, at=at) for reader, reply in found.items()}
        self._ask(bodies, now_s, partial(self._respond, event))

    def _respond(self, event: RequestReceived, replies: _Replies, _now_s: float) -> None:
        """Answer with what every reader says."""
        act = self._acts.get(event.handle)
        if act is None:
            return  # the topic ended meanwhile
        own = bytes(self._context.member.name) if act == SHOW else None
        said = [_said(reader, reply, own) for reader, reply in replies.items()] or [(False, NO_READER)]
        endpoint, is_success = self._dispatcher.endpoint, all(each for each, _ in said)
        text = printable("; ".join(text for _, text in said))
        endpoint.answer(event.handle, event.ticket, trigger_response(text, endpoint.ros, is_success=is_success))


def _said(reader: Name, reply: Reply | None, own: bytes | None) -> tuple[bool, str]:
    """Return whether a reader did what was asked, or names ``own`` as the holder, and what it says."""
    result = {} if reply is None else reply.result
    if reply is None or not has_control(result):
        return False, f"{reader.short}: {NO_ANSWER}"
    holder, error = result.get("holder"), result.get("error")
    state = f"{result['state']} by {holder}" if holder else result["state"]
    return not error if own is None else result.get("peer") == own, f"{reply.member.label}: {error or state}"


def trigger_response(text: str, ros: RosVersion, *, is_success: bool) -> bytes:
    """Return the response of a ``std_srvs/srv/Trigger`` in the wire form of a ROS."""
    message = string_message(text, ros)
    if ros == 1:
        return bytes([is_success]) + message
    return message[:_CDR_BYTES] + bytes([is_success, 0, 0, 0]) + message[_CDR_BYTES:]
