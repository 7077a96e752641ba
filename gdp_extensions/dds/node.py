"""Node: one DDS participant that appears as one ROS 2 node, with its readers and writers.

I/O. What DDS refuses raises ``LocalError``.
A program without ``rmw`` does not read the variables of the discovery range, so nodes that stay on this host would
never meet it. LOCALHOST means no multicast, and this host as the only peer.
Source: ROS 2 documentation, "Improved dynamic discovery"; Cyclone DDS configuration guide, ``Discovery/Peers``;
rmw_dds_common for the announcement of nodes; the binding's own samples of built-in topics.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from cyclonedds._clayer import ddspy_take
from cyclonedds.core import DDSException, DDSStatus, InstanceState, Policy, ReadCondition, SampleState, ViewState
from cyclonedds.core import Qos as DdsQos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.sub import DataReader, Subscriber

from gdp.errors import LocalError
from gdp_extensions.dds import library
from gdp_extensions.dds.graph_cache import GraphCache
from gdp_extensions.dds.naming import user_data
from gdp_extensions.dds.node_info import GID_BYTES, INFO_HASH, INFO_TOPIC, INFO_TYPE, write_info
from gdp_extensions.dds.opaque import OpaqueTopic
from gdp_extensions.dds.profile import offered
from gdp_extensions.dds.wait_thread import News, WaitThread
from proxy.endpoints.core.endpoint import Event
from proxy.endpoints.core.qos import default

_URI: Final = "CYCLONEDDS_URI"
_RANGE: Final = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_LOCALHOST_ONLY: Final = "ROS_LOCALHOST_ONLY"  # until Iron; the range takes precedence
_PARTICIPANTS_MAX: Final = 32
_LOCALHOST: Final = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
    f"<MaxAutoParticipantIndex>{_PARTICIPANTS_MAX}</MaxAutoParticipantIndex>"
    '<Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)
_KNOWN: Final = ("SUBNET", "LOCALHOST", "SYSTEM_DEFAULT")
ANY_STATE: Final = SampleState.Any | ViewState.Any | InstanceState.Any
_BATCH: Final = 64  # samples read at once


class Sample(NamedTuple):
    """One message that a reader took."""

    raw: bytes
    writer: int  # instance handle
    stamp_ns: int  # wall clock, when it was read


class Reader:
    """A reader of this node; its samples are passed to ``hear`` in the caller's thread."""

    def __init__(
        self, node: Node, topic: str, type_name: str, qos: DdsQos, hear: Callable[[list[Sample]], None]
    ) -> None:
        self._topic = OpaqueTopic(node.participant, topic, type_name)
        self._entity = DataReader(node.subscriber, self._topic.topic, qos=qos)
        self.gid = bytes(self._entity.guid.bytes)
        self._hear = hear
        self.ref = int(self._entity._ref)
        self._condition = ReadCondition(self._entity, ANY_STATE)
        self._source = int(self._condition._ref)
        self._watch = node.watch
        self._number = self._watch.add(self._source, self._drain)

    def close(self) -> None:
        """Stop reading."""
        self._hear = _nothing
        self._watch.remove(self._source, self._number)
        del self._condition, self._entity
        self._topic.close()

    def _drain(self) -> News | None:
        taken = ddspy_take(self._source, ANY_STATE, _BATCH)
        if not isinstance(taken, list):
            return None  # closed in the meantime
        now_ns = time.time_ns()
        samples = [Sample(raw, info.publication_handle, now_ns) for raw, info in taken if info.valid_data]
        return (lambda: self._hear(samples)) if samples else None


class Writer:
    """A writer of this node."""

    def __init__(self, node: Node, topic: str, type_name: str, qos: DdsQos) -> None:
        self._topic = OpaqueTopic(node.participant, topic, type_name)
        self._entity = DataWriter(node.publisher, self._topic.topic, qos=qos)
        self.gid = bytes(self._entity.guid.bytes)
        self.ref = int(self._entity._ref)
        self.handle = int(self._entity.get_instance_handle()) % (1 << 64)
        self._watch = node.watch
        self._number: int | None = None

    def tell_matches(self, matched: News) -> None:
        """Register a callback for joined or departed readers; it runs in the caller's thread."""

        def drain() -> News:
            library.matches(self.ref, DDSStatus.PublicationMatched)
            return matched

        self._entity.set_status_mask(DDSStatus.PublicationMatched)
        self._number = self._watch.add(self.ref, drain)

    def write(self, raw: bytes) -> int:
        """Write CDR with its encapsulation; return 0, or a negative code of DDS."""
        odd = len(raw) % 4
        return library.write(self.ref, raw + bytes(4 - odd) if odd else raw)

    def close(self) -> None:
        """Close the writer."""
        if self._number is not None:
            self._watch.remove(self.ref, self._number)
        del self._entity
        self._topic.close()


class Node:
    """A participant."""

    def __init__(self, domain: int, name: str) -> None:
        self._name = name
        if (uri := with_discovery_range(os.environ)) is not None:
            os.environ["CYCLONEDDS_URI"] = uri  # the library reads it when the first participant begins
        try:
            self.participant = DomainParticipant(domain, qos=DdsQos(Policy.Userdata(b"enclave=/;")))
        except DDSException as error:
            raise LocalError(f"DDS domain {domain} cannot be joined: {error}") from error
        self.gid = bytes(self.participant.guid.bytes)
        self.publisher = Publisher(self.participant)
        self.subscriber = Subscriber(self.participant)
        self.watch = WaitThread(self.participant)
        self._readers: dict[bytes, Reader] = {}
        self._writers: dict[bytes, Writer] = {}
        self._wide = GID_BYTES[0]
        qos = offered(default(latched=True, depth=1), user_data(INFO_HASH))
        self._info = Writer(self, INFO_TOPIC, INFO_TYPE, qos)
        self.announce()

    def read(self, topic: str, type_name: str, qos: DdsQos, hear: Callable[[list[Sample]], None]) -> Reader:
        """Open a reader of the node."""
        try:
            reader = Reader(self, topic, type_name, qos, hear)
        except DDSException as error:
            raise LocalError(f"DDS refuses to read {topic} as {type_name}: {error}") from error
        self._readers[reader.gid] = reader
        self.announce()
        return reader

    def write(self, topic: str, type_name: str, qos: DdsQos) -> Writer:
        """Open a writer of the node."""
        try:
            writer = Writer(self, topic, type_name, qos)
        except DDSException as error:
            raise LocalError(f"DDS refuses to write {topic} as {type_name}: {error}") from error
        self._writers[writer.gid] = writer
        self.announce()
        return writer

    def close(self, *ends: Reader | Writer) -> None:
        """Close readers and writers of the node."""
        for end in ends:
            del (self._readers if isinstance(end, Reader) else self._writers)[end.gid]
            end.close()
        self.announce()

    def write_gids(self, wide: int) -> None:
        """Write GIDs of the same length as local peers do, in bytes."""
        if wide != self._wide:
            self._wide = wide
            self.announce()

    def announce(self) -> None:
        """Announce the node's readers and writers."""
        self._info.write(write_info(self.gid, self._name, [*self._readers], [*self._writers], self._wide))

    def leave(self) -> None:
        """Leave the domain and free everything."""
        ends: list[Reader | Writer] = [*self._readers.values(), *self._writers.values(), self._info]
        for end in ends:
            end.close()
        self._readers.clear()
        self._writers.clear()
        self.watch.close()
        del self._info, self.publisher, self.subscriber, self.participant


class EntityContext(NamedTuple):
    """What an entity of the endpoint needs: the node, the graph, its handle, and where its events go."""

    node: Node
    survey: GraphCache
    handle: int
    tell: Callable[[Event], None]


def _nothing(samples: list[Sample]) -> None:
    """Ignore samples that arrive after the end."""
    del samples


def with_discovery_range(environment: Mapping[str, str]) -> str | None:
    """Return the value of CYCLONEDDS_URI that obeys the discovery range; None: it needs no change.

    What CYCLONEDDS_URI says already is kept and comes last, so it wins.

    Raises:
        LocalError: a range that this endpoint cannot have, or that ROS does not know.
    """
    stated = environment.get(_RANGE, "").upper()
    if not stated:
        stated = "LOCALHOST" if environment.get(_LOCALHOST_ONLY, "0") not in ("", "0") else "SYSTEM_DEFAULT"
    if stated not in _KNOWN:
        raise LocalError(
            f"{_RANGE}={stated}: the endpoint dds knows {', '.join(_KNOWN)}; with OFF no node could meet the proxy"
        )
    configured = environment.get(_URI, "")
    if stated != "LOCALHOST" or configured.startswith(_LOCALHOST):
        return None
    return ",".join(filter(None, (_LOCALHOST, configured)))
