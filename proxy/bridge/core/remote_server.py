"""Remote server: decoders of its responses and news, and the local description of its service.

Sans-I/O, except that it queries the local endpoint for known types.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from gdp.errors import LocalError
from proxy.bridge.core.action_interface import ActionInterface
from proxy.bridge.core.decoder import MessageDecoder
from proxy.config.rule import Rule
from proxy.endpoints.core.endpoint import RosEndpoint
from proxy.serial.channel import Channel, Service
from proxy.serial.serializer import Encoding
from proxy.wire.service import Exchange


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoteServer:
    """One incarnation of a remote server.

    Args:
        exchange: the same, decoded; None where it has no valid form here.
        ours: the service as this machine describes it.
    """

    incarnation: int
    description: bytes
    exchange: Exchange | None = None
    ours: Exchange | None = None
    answers: tuple[MessageDecoder, ...] = ()
    news: tuple[MessageDecoder, ...] = ()

    @classmethod
    def set_description(
        cls, incarnation: int, description: bytes, parts: ActionInterface, endpoint: RosEndpoint, rule: Rule
    ) -> RemoteServer:
        """Prepare the decoders of a server's responses.

        Raises:
            LocalError: it serves something else, or this machine cannot know it.
            RemoteError: it cannot be read.
        """
        theirs, ros = Exchange.from_cbor(description), endpoint.ros
        types = [*(each.type_name for each in theirs.services), *(each.type_name for each in theirs.topics)]
        if types != [type_name for _, type_name in (*parts.services, *parts.topics)]:
            raise LocalError(f"the far side serves something else under this name: {', '.join(types)}")
        ours = _ours(theirs, parts, endpoint, rule.encoding)
        ready = partial(MessageDecoder.ready, is_strict=rule.is_strict)
        services = zip(theirs.services, ours.services, strict=True)
        topics = zip(theirs.topics, ours.topics, strict=True)
        server = cls(
            incarnation=incarnation,
            description=description,
            exchange=theirs,
            ours=ours,
            answers=tuple(ready(a.response, theirs.encoding, b.response, ros) for a, b in services),
            news=tuple(ready(a, theirs.encoding, b, ros) for a, b in topics),
        )
        for our, their in zip(ours.services, theirs.services, strict=True):
            ready(our.request, ours.encoding, their.request, their.ros)  # raises with the reason
        return server

    def described_again(self, description: bytes) -> RemoteServer | None:
        """Return the same server with a new leaving flag; None where the description differs otherwise."""
        if self.exchange is None:
            return None
        exchange = replace(self.exchange, is_leaving=not self.exchange.is_leaving)
        if exchange.to_cbor() != description:
            return None
        return replace(self, description=description, exchange=exchange)

    @property
    def is_leaving(self) -> bool:
        """Return whether the server leaves soon."""
        return self.exchange is not None and self.exchange.is_leaving


def _ours(theirs: Exchange, parts: ActionInterface, endpoint: RosEndpoint, encoding: Encoding) -> Exchange:
    """Return this machine's description of the service, built from the remote definitions where it has none."""
    from proxy.serial.converter import translated_channel
    from proxy.serial.service_converter import translated_service

    services = list[Service]()
    for (name, type_name), their in zip(parts.services, theirs.services, strict=True):
        try:
            services.append(endpoint.service(name, type_name))
        except LocalError:
            same = their if their.ros == endpoint.ros else translated_service(their, endpoint.ros)
            services.append(replace(same, name=name))
    topics = list[Channel]()
    for (name, type_name), channel in zip(parts.topics, theirs.topics, strict=True):
        try:
            topics.append(endpoint.channel(name, type_name))
        except LocalError:
            same_channel = channel if channel.ros == endpoint.ros else translated_channel(channel, endpoint.ros)
            topics.append(replace(same_channel, topic=name))
    return Exchange(encoding, tuple(services), tuple(topics))
