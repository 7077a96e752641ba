"""Sender of the responses and news of one exposed service to remote clients.

I/O through the overlay's participant and publisher.
"""

from __future__ import annotations

from gdp.client.publisher import Publisher
from gdp.errors import LocalError
from gdp.message.loss import LossReason
from gdp.names import Name
from gdp.service.frames import Answer, Outcome
from gdp.service.serving import Asked, Serving
from proxy.bridge.faults import Fault
from proxy.bridge.service_flow import ServiceFlow
from proxy.serial.serializer import Serializer
from proxy.wire.service import Exchange, News, too_large


class ResponseSender:
    """Encodes and sends the messages of the local server.

    Args:
        serving: keeps responses for clients that repeat a request.
        publisher: the stream that all clients receive.
    """

    def __init__(self, flow: ServiceFlow, exchange: Exchange, serving: Serving[bytes], publisher: Publisher) -> None:
        self._flow = flow
        self._serving = serving
        self._publisher = publisher
        encoding = flow.flow_spec.rule.encoding
        self._responses = [Serializer(each.response, encoding) for each in exchange.services]
        self._news = [Serializer(each, encoding) for each in exchange.topics]

    def respond(self, asked: Asked, raw: bytes) -> None:
        """Send a response of the local server; one that is too large fails the call."""
        body = self._responses[asked.part].encode(raw)
        if reason := too_large("an answer", len(raw), self._flow.flow_spec.rule.max_bytes, len(body)):
            self.fail(asked, Fault.TOO_LARGE, reason)
        else:
            self._send(asked, Answer(asked.part, asked.call, Outcome.ANSWERED, body))

    def fail(self, asked: Asked, fault: Fault, reason: str) -> None:
        """Report a fault, and send its reason in place of a response."""
        self._flow.report(fault, reason)
        self.refuse(asked, reason)

    def refuse(self, asked: Asked, reason: str) -> None:
        """Send a reason in place of a response."""
        self._send(asked, Answer.failed(asked.part, asked.call, reason))

    def send_wire(self, client: Name, wire: bytes) -> None:
        """Send bytes to one client; nothing is sent to a client that has gone."""
        try:
            self._flow.context.member.services.respond(self._flow.name, client, wire)
        except LocalError:
            self._flow.context.traffic.unread += 1  # the client is gone
            return
        self._flow.context.traffic.sent(len(wire))

    def publish_news(self, at: int, raw: bytes, stamp_ns: int) -> None:
        """Send a message of an action's topic to all clients.

        Args:
            stamp_ns: when the local server sent it, in nanoseconds since 1970.
        """
        publisher, services = self._publisher, len(self._responses)
        if not publisher.is_wanted:
            self._flow.context.traffic.unread += 1
            publisher.skip(LossReason.NO_READER)
            return
        if not publisher.has_space():
            self._flow.report(Fault.TOO_FAST, "news come faster than clients confirm them")
            publisher.skip(LossReason.WINDOW_OVERFLOW)
            return
        body = self._news[at].encode(raw)
        if reason := too_large("news", len(raw), self._flow.flow_spec.rule.max_bytes, len(body)):
            self._flow.report(Fault.TOO_LARGE, reason)
            publisher.skip(LossReason.TOO_LARGE)
            return
        wire = News(services + at, stamp_ns, body).to_wire()
        publisher.publish(wire)
        self._flow.context.traffic.sent(len(wire))

    def _send(self, asked: Asked, answer: Answer) -> None:
        if asked.client == self._flow.context.member.name:
            return  # the proxy's own request that cancels a goal
        wire = answer.to_wire()
        self._serving.remember(asked, wire)
        self.send_wire(asked.client, wire)
        error = answer.reason if answer.outcome is Outcome.FAILED else ""
        self._flow.context.tracer.served(self._flow.call_key(*asked), error)
