"""Local publishers of an imported topic: one for all remote publishers, or one for each of their channels.

I/O through the endpoint. A live graph gets one virtual publisher. If a new one must replace it to promise more, the new
one gets the messages that a latched topic keeps. Readers then get them again, as from any publisher that restarts. A
recording gets every channel as its remote publisher describes it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, Protocol

from gdp.errors import LocalError
from proxy.bridge.core.decoder import MessageDecoder
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.endpoint_dispatch import EndpointDispatcher, EventHandler
from proxy.bridge.faults import Fault
from proxy.endpoints.core.endpoint import GraphEntity, MessageRecorder, Origin
from proxy.endpoints.core.qos import joint, offer
from proxy.serial.channel import NEVER, Channel, Qos
from proxy.serial.serializer import Encoding
from proxy.wire.message import CHANNELS_MAX

_FAR_MAX: Final = 1_024  # publishers whose QoS is kept; the oldest are dropped
_PUBLISHERS_MAX: Final = 4_096  # publishers whose channels are counted; the oldest are dropped


class LocalOutput(Protocol):
    """Output of the messages of one imported topic."""

    refusal: Fault  # the fault of channels that cannot be added

    @property
    def is_open(self) -> bool:
        """Return whether messages can be published now."""

    @property
    def fulfilled(self) -> Qos | None:
        """Return what local readers are offered of known remote publishers' QoS; None: none is known."""

    def decoder(self, source: Channel, encoding: Encoding) -> MessageDecoder:
        """Return the decoder that turns bodies of a remote channel into local messages."""

    def add(self, publisher: bytes, sources: Sequence[Channel], targets: Sequence[Channel]) -> list[int]:
        """Add the channels of a remote publisher; return a handle for each.

        Args:
            sources: descriptions by the remote side.
            targets: descriptions on this machine.

        Raises:
            LocalError: the endpoint does not accept one of them.
        """

    def publish(self, handle: int, raw: bytes, origin: Origin) -> None:
        """Publish one message. Raises ``LocalError``: it cannot be written."""

    def receive_readers(self, ends: Sequence[GraphEntity]) -> None:
        """Update the local readers."""

    def set_offered(self, flow_spec: FlowSpec) -> None:
        """Replace the QoS that the far side states; it holds until a publisher is known."""

    @property
    def has_lease(self) -> bool:
        """Return whether local readers are to learn that no remote publisher is left."""

    def set_alive(self, is_alive: bool) -> None:
        """Let local readers learn whether a remote publisher is left."""

    def drop_kept(self) -> None:
        """Drop messages kept for late joiners, when the last local reader has left."""

    def close(self) -> None:
        """Close the advertised publishers."""


class MergedPublisher:
    """One virtual publisher in a live graph."""

    refusal = Fault.UNKNOWN_TYPE

    def __init__(self, dispatcher: EndpointDispatcher, owner: EventHandler, flow_spec: FlowSpec) -> None:
        self._dispatcher = dispatcher
        self._owner = owner
        self._flow_spec = flow_spec
        self._wants: tuple[Qos, ...] = ()
        self._handle: int | None = None
        self._channel: Channel | None = None  # as it is offered locally
        self._far: dict[bytes, Qos] = {}  # offered QoS of the publishers, by name
        self._kept = deque[bytes]()  # messages for late joiners, for a publisher that replaces this one
        if (known := self._known()) is not None:  # else the remote definition may serve
            self._offer(known)

    @property
    def is_open(self) -> bool:
        """Return whether its type is known; the virtual publisher exists, or the next message makes it."""
        return self._channel is not None

    @property
    def has_lease(self) -> bool:
        """Return whether a local reader is offered a lease of liveliness."""
        return self._channel is not None and self._channel.qos[0].lease != NEVER

    @property
    def fulfilled(self) -> Qos | None:
        """Return what is offered, once a remote publisher is known."""
        return self._channel.qos[0] if self._far and self._channel is not None else None

    def decoder(self, source: Channel, encoding: Encoding) -> MessageDecoder:
        """Return a decoder by the remote definition that converts into this machine's."""
        ros, is_strict = self._dispatcher.endpoint.ros, self._flow_spec.rule.is_strict
        return MessageDecoder.ready(source, encoding, self._known(), ros, is_strict=is_strict)

    def add(self, publisher: bytes, sources: Sequence[Channel], targets: Sequence[Channel]) -> list[int]:
        """Offer the QoS of a remote publisher; its channels share the virtual publisher."""
        source = sources[0]
        self._far[publisher] = joint(source)
        while len(self._far) > _FAR_MAX:
            del self._far[next(iter(self._far))]
        self._offer(targets[0])
        return [0] * len(targets)

    def publish(self, handle: int, raw: bytes, origin: Origin) -> None:
        """Publish one message by the virtual publisher, if its type is known."""
        del handle, origin
        if self._handle is None:
            self.set_alive(True)
        if self._handle is not None:
            self._dispatcher.endpoint.publish(self._handle, raw)
            self._kept.append(raw)

    def receive_readers(self, ends: Sequence[GraphEntity]) -> None:
        """Offer the QoS that local readers require."""
        self._wants = tuple(end.qos for end in sorted(ends, key=lambda end: end.key) if end.qos is not None)
        if self._channel is not None:
            self._offer(self._channel)

    def set_offered(self, flow_spec: FlowSpec) -> None:
        """Offer the QoS that the far side states, until a publisher is known."""
        self._flow_spec = flow_spec
        if self._channel is not None and not self._far:
            self._offer(self._channel)

    def set_alive(self, is_alive: bool) -> None:
        """Close the virtual publisher while no remote one is left: for DDS, liveliness is lost."""
        if not is_alive:
            self.close()
        elif self._handle is None and self._channel is not None:
            self._offer(self._channel)

    def drop_kept(self) -> None:
        """Close a latched publisher: its messages become outdated, and arrive again with the next reader."""
        if self._channel is not None and self._channel.latched:
            self._kept.clear()
            self.close()

    def close(self) -> None:
        """Close the virtual publisher."""
        if self._handle is not None:
            self._dispatcher.close(self._handle)
            self._handle = None

    def _known(self) -> Channel | None:
        try:
            return self._dispatcher.endpoint.channel(self._flow_spec.local, self._flow_spec.type_name)
        except LocalError:
            return None

    def _offer(self, channel: Channel) -> None:
        """Create the publisher with the remote QoS, within what local readers allow; replace it where they change."""
        rule = self._flow_spec.rule
        stated = () if rule.offered is None else (Qos(**rule.offered.model_dump()),)
        far, latched, reliable = tuple(self._far.values()) or stated, rule.wants_latched, rule.wants_reliable
        profile = offer(far, self._wants, is_latched=latched, is_reliable=reliable, is_known=bool(self._far))
        latched = profile.durability == "transient_local"
        offered = replace(channel, topic=self._flow_spec.local, qos=(profile,), latched=latched, callerid=None)
        if self._handle is not None and self._channel is not None and _is_served(self._channel, offered):
            return
        self.close()
        self._handle = self._dispatcher.advertise(self._owner, offered)
        self._channel = offered
        self._kept = deque(self._kept if latched else (), maxlen=profile.depth if latched else 0)
        for raw in self._kept:
            self._dispatcher.endpoint.publish(self._handle, raw)


class ChannelPublishers:
    """Publishers for each remote channel, under the rule's own name; nothing is converted."""

    refusal = Fault.REFUSED
    is_open = True
    has_lease = False
    fulfilled = None

    def __init__(self, dispatcher: EndpointDispatcher, owner: EventHandler, flow_spec: FlowSpec) -> None:
        self._dispatcher = dispatcher
        self._owner = owner
        self._flow_spec = flow_spec
        self._handles: dict[bytes, set[int]] = {}  # of each remote publisher
        endpoint = dispatcher.endpoint
        self._recorder = endpoint if isinstance(endpoint, MessageRecorder) else None

    def decoder(self, source: Channel, encoding: Encoding) -> MessageDecoder:
        """Return a decoder by the remote definition alone."""
        return MessageDecoder(source, encoding, source, None)

    def add(self, publisher: bytes, sources: Sequence[Channel], targets: Sequence[Channel]) -> list[int]:
        """Return the handles of a remote publisher's channels, of bounded number; equal channels share a handle."""
        del sources
        known = self._handles.setdefault(publisher, set())
        if len(self._handles) > _PUBLISHERS_MAX:
            del self._handles[next(iter(self._handles))]
        handles = list[int]()
        for target in targets:
            if len(known) >= CHANNELS_MAX:
                raise LocalError(f"its publisher has described more than {CHANNELS_MAX} channels")
            handles.append(self._dispatcher.advertise(self._owner, replace(target, topic=self._flow_spec.local)))
            known.add(handles[-1])
        return handles

    def publish(self, handle: int, raw: bytes, origin: Origin) -> None:
        """Record one message of a channel."""
        if self._recorder is not None:
            self._recorder.record(handle, raw, origin)
        else:
            self._dispatcher.endpoint.publish(handle, raw)

    def receive_readers(self, ends: Sequence[GraphEntity]) -> None:
        """Ignore the readers: a recording reads everything."""

    def set_offered(self, flow_spec: FlowSpec) -> None:
        """Ignore it: every channel is recorded as its publisher describes it."""

    def set_alive(self, is_alive: bool) -> None:
        """Ignore it: a recording has no readers."""

    def drop_kept(self) -> None:
        """Drop nothing: a recording keeps everything."""

    def close(self) -> None:
        """Close every channel's publisher."""
        for handle in set().union(*self._handles.values()):
            self._dispatcher.close(handle)
        self._handles.clear()


def _is_served(standing: Channel, wanted: Channel) -> bool:
    """Return whether an existing publisher suffices for a wanted one: equal, or differing only by a smaller depth."""
    if replace(standing, qos=()) != replace(wanted, qos=()):
        return False
    before, after = standing.qos[0], wanted.qos[0]
    if standing.ros == 1:  # has no QoS, except how many messages a latched publisher keeps
        return not standing.latched or before.depth >= after.depth
    return replace(before, depth=0) == replace(after, depth=0) and before.depth >= after.depth
