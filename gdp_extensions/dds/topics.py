"""Topics of the virtual node: a subscription and a publisher.

I/O, through the node.
"""

from __future__ import annotations

from dataclasses import replace

from gdp.errors import LocalError
from gdp_extensions.dds import library
from gdp_extensions.dds.naming import dds_type, user_data
from gdp_extensions.dds.node import EntityContext, Sample
from gdp_extensions.dds.profile import offered, requested
from proxy.endpoints.core.endpoint import EndpointError, MessageReceived, Role, TypeResolved
from proxy.endpoints.core.qos import default
from proxy.serial.channel import Channel, Qos
from proxy.serial.standard_types import standard_channel


class Subscription:
    """Subscribes to a topic; its type need not be known here."""

    def __init__(self, at: EntityContext, topic: str, type_name: str, qos: Qos | None) -> None:
        self._node, self._survey, self._handle, self._tell = at
        self._bare = Channel(topic, type_name, 2)
        self._channel: Channel | None = None
        self._fault = ""
        self.follow()
        shown = self._channel.hash if self._channel is not None else ""
        profile = requested(qos or default(), user_data(shown))
        self._reader = at.node.read(f"rt{topic}", dds_type(type_name), profile, self._hear)

    def follow(self) -> None:
        """Update the publishers, and with them the description of the messages."""
        topic, type_name = self._bare.topic, self._bare.type_name
        hashes = sorted({peer.hash for peer in self._survey.peers(Role.PUBLISHES, topic, type_name)} - {""})
        # A description remains valid while there are publishers of its hash.
        if self._channel is None or (hashes and self._channel.hash not in hashes):
            self._describe(hashes[0] if hashes else "")
        fault = f"publishers disagree about {type_name}: {', '.join(hashes)}" if len(hashes) > 1 else ""
        if fault and fault != self._fault:
            self._tell(EndpointError(self._handle, fault))
        self._fault = fault

    def close(self) -> None:
        """Close the subscription."""
        self._node.close(self._reader)

    def _describe(self, peers_hash: str) -> None:
        known = standard_channel(self._bare.topic, self._bare.type_name)
        if known is None or (peers_hash and known.hash != peers_hash):
            known = replace(self._bare, hash=peers_hash)
        if known != self._channel:
            self._channel = known
            self._tell(TypeResolved(self._handle, known))

    def _hear(self, samples: list[Sample]) -> None:
        for raw, _, stamp_ns in samples:
            self._tell(MessageReceived(self._handle, stamp_ns, raw))


class Publication:
    """Publishes a topic. Raises ``LocalError``: it has another type here, or is not ROS 2's."""

    def __init__(self, at: EntityContext, channel: Channel, type_hash: str) -> None:
        topic, type_name = channel.topic, channel.type_name
        roles = (Role.PUBLISHES, Role.SUBSCRIBES)
        theirs = {peer.hash for role in roles for peer in at.survey.peers(role, topic, type_name)} - {""}
        if type_hash and theirs and type_hash not in theirs:
            raise LocalError(f"{topic}: {type_name} is {', '.join(sorted(theirs))} on this machine, not {type_hash}")
        self._node, _, self._handle, self._tell = at
        self._is_late = False
        qos = channel.qos[0] if channel.qos else default(latched=channel.latched, depth=1 if channel.latched else 10)
        profile = offered(qos, user_data(type_hash))
        self._writer = at.node.write(f"rt{topic}", dds_type(type_name), profile)

    @property
    def subscribers(self) -> int:
        """Return the present number of readers."""
        return library.count_readers(self._writer.ref)

    def publish(self, raw: bytes) -> None:
        """Publish one message."""
        code = self._writer.write(raw)
        if code < 0 and not self._is_late:
            why = "its readers do not keep up" if code == library.TIMED_OUT else f"Cyclone DDS refuses it (code {code})"
            self._tell(EndpointError(self._handle, f"a message of {len(raw)} bytes was not published: {why}"))
        self._is_late = code < 0

    def close(self) -> None:
        """Close the publisher."""
        self._node.close(self._writer)
