"""Discovery of other participants by Cyclone DDS, passed on to a graph cache.

I/O. Cyclone's built-in topics report participants, readers and writers; ``ros_discovery_info`` reports their nodes.
The binding reads policies into variables that all threads share, and never frees user data. So the QoS profile and the
user data of an entity are read from the C structure directly.
"""

from __future__ import annotations

import ctypes as ct
from collections.abc import Callable
from typing import Final, NamedTuple

from cyclonedds.__library__ import library_path
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
from gdp_extensions.dds.profile import requested
from gdp_extensions.dds.wait_thread import News
from proxy.endpoints.core.qos import default
from proxy.serial.channel import NEVER, Qos

_SECOND: Final = 1_000_000_000
_FOREVER: Final = (1 << 63) - 1
_LIVELINESS: Final = ("automatic", "manual_by_participant", "manual_by_topic")

_library = ct.CDLL(str(library_path))
_free = _library.dds_free
_free.argtypes = (ct.c_void_p,)
_free.restype = None
_BATCH: Final = 64
_INFO_DEPTH: Final = 1_000  # so many participants may exist before this one joins
_HANDLES: Final = 1 << 64


class Announced(NamedTuple):
    """A profile and its user data."""

    qos: Qos
    user_data: bytes


def announced(policies: int) -> Announced:
    """Return the announced policies of a peer; missing ones have DDS's defaults.

    Args:
        policies: the address of the C structure.
    """
    history, depth = _pair("history", policies, ct.c_int32, (0, 0))
    reliability, _ = _pair("reliability", policies, ct.c_int64, (0, 0))
    liveliness, lease = _pair("liveliness", policies, ct.c_int64, (0, _FOREVER))
    durability = ct.c_int(0)
    _get("durability", policies, durability)
    deadline, lifespan = ct.c_int64(_FOREVER), ct.c_int64(_FOREVER)
    _get("deadline", policies, deadline)
    _get("lifespan", policies, lifespan)
    qos = Qos(
        history="keep_all" if history else "keep_last",
        depth=max(depth, 0),
        reliability="reliable" if reliability else "best_effort",
        durability="transient_local" if durability.value else "volatile",
        deadline=_duration(deadline.value),
        lifespan=_duration(lifespan.value),
        liveliness=_LIVELINESS[liveliness],
        lease=_duration(lease),
    )
    return Announced(qos, _user_data(policies))


def _get(policy: str, policies: int, *into: ct._SimpleCData[int]) -> bool:
    function = getattr(_library, f"dds_qget_{policy}")
    function.restype = ct.c_bool
    return bool(function(ct.c_void_p(policies), *(ct.byref(each) for each in into)))


def _pair(
    policy: str, policies: int, kind: type[ct.c_int32 | ct.c_int64], otherwise: tuple[int, int]
) -> tuple[int, int]:
    first, second = ct.c_int(otherwise[0]), kind(otherwise[1])
    return (first.value, second.value) if _get(policy, policies, first, second) else otherwise


def _user_data(policies: int) -> bytes:
    address, size = ct.c_void_p(), ct.c_size_t()
    _library.dds_qget_userdata.restype = ct.c_bool
    is_there = _library.dds_qget_userdata(ct.c_void_p(policies), ct.byref(address), ct.byref(size))
    if not is_there or not address.value:
        return b""
    data = ct.string_at(address.value, size.value)
    _free(address)
    return data


def _duration(nanoseconds: int) -> tuple[int, int]:
    return NEVER if nanoseconds >= _FOREVER else divmod(nanoseconds, _SECOND)


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
