"""Discovery of other participants by Cyclone DDS, passed on to a graph cache.

I/O. Cyclone's built-in topics report participants, readers and writers; ``ros_discovery_info`` reports their nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from cyclonedds._clayer import ddspy_take_endpoint, ddspy_take_participant
from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import InstanceState, ReadCondition
from cyclonedds.internal import SampleInfo

from gdp_extensions.dds.graph_cache import GraphCache, Peer
from gdp_extensions.dds.naming import hash_in, identity_in, named, user_data
from gdp_extensions.dds.node import ANY_STATE, Node, Sample
from gdp_extensions.dds.node_info import INFO_HASH, INFO_TOPIC, INFO_TYPE, read_info
from gdp_extensions.dds.policies import Announced, announced
from gdp_extensions.dds.profile import requested
from gdp_extensions.dds.wait_thread import News
from proxy.endpoints.core.qos import default

_BATCH: Final = 64
_INFO_DEPTH: Final = 1_000  # so many participants may exist before this one joins
_HANDLES: Final = 1 << 64


class Discovery:
    """Source of a graph cache's updates; ``changed``: called in the caller's thread after each batch of updates."""

    def __init__(self, node: Node, survey: GraphCache, changed: News) -> None:
        self._node = node
        self._survey = survey
        self._changed = changed
        self._readers = [
            self._open(BuiltinTopicDcpsParticipant, ddspy_take_participant, self._participant),
            self._open(BuiltinTopicDcpsPublication, ddspy_take_endpoint, self._end(is_writer=True)),
            self._open(BuiltinTopicDcpsSubscription, ddspy_take_endpoint, self._end(is_writer=False)),
        ]
        profile = requested(default(latched=True, depth=_INFO_DEPTH), user_data(INFO_HASH))
        node.read(INFO_TOPIC, INFO_TYPE, profile, self._reported)

    def close(self) -> None:
        """Stop discovery."""
        for _, condition, number in self._readers:
            self._node.watch.remove(condition._ref, number)
        self._readers.clear()

    def _open(
        self, topic: BuiltinDataReader, take: Callable[..., object], make: Callable[..., News | None]
    ) -> tuple[BuiltinDataReader, ReadCondition, int]:
        reader = BuiltinDataReader(self._node.subscriber, topic)
        condition = ReadCondition(reader, ANY_STATE)

        def drain() -> News | None:
            taken = take(condition._ref, _BATCH, make, announced)
            news = [each for each in taken if each is not None] if isinstance(taken, list) else []
            return (lambda: self._learn(news)) if news else None

        return reader, condition, self._node.watch.add(condition._ref, drain)

    def _learn(self, news: list[News]) -> None:
        for each in news:
            each()
        self._changed()

    def _participant(self, gid: bytes, said: Announced | None, info: SampleInfo) -> News | None:
        handle = info.instance_handle % _HANDLES
        if not _is_there(info):
            return lambda: self._survey.left(handle)
        if gid == self._node.gid or said is None or not said.user_data.startswith(b"enclave="):
            return None
        return lambda: self._survey.joined(handle, gid)

    def _end(self, *, is_writer: bool) -> Callable[..., News | None]:
        def make(
            gid: bytes,
            participant: bytes,
            participant_handle: int,
            topic: str | None,
            type_name: str | None,
            said: Announced | None,
            info: SampleInfo,
            type_id: bytes | None,
        ) -> News | None:
            del participant_handle, type_id
            handle = info.instance_handle % _HANDLES
            if not _is_there(info):
                return lambda: self._survey.lost(handle)
            if participant == self._node.gid or not topic or said is None:
                return None
            if not topic.startswith(("rt/", "rq/", "rr/")):
                return None
            what = named(topic, type_name or "", is_writer=is_writer)
            peer = Peer(gid, what, hash_in(said.user_data), said.qos, identity_in(said.user_data))
            return lambda: self._survey.found(handle, peer)

        return make

    def _reported(self, samples: list[Sample]) -> None:
        for sample in samples:
            info = read_info(sample.raw)
            if info is not None:
                self._survey.receive_node_info(info)
                self._node.write_gids(info.gid_bytes)
        self._changed()


def _is_there(info: SampleInfo) -> bool:
    return bool(info.valid_data) and info.instance_state == InstanceState.Alive
