"""Opaque DDS topics: only the type's name is known, and any bytes can be written and read.

I/O. A type of one octet is the shortest possible ROS message (ROS gives empty ones a dummy octet). Cyclone checks that
the octet exists and accepts any further bytes. The structure of the type must not be announced, because peers that know
the real one would not match: ROS announces the name alone. Cyclone has no option for that, so the length of the
announcement is set to zero while readers and writers of the topic exist.
"""

from __future__ import annotations

import ctypes as ct
import dataclasses
import types
from functools import cache
from typing import Final

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from cyclonedds.topic import Topic

from gdp.errors import LocalError
from gdp_extensions.dds.library import sertype_of

_WORDS: Final = 64  # of the C description, searched for the type's Python object
_LENGTH_AT: Final = 3  # words after it: the object, flags, the announcement's address, its length
_WORD: Final = 8


class OpaqueTopic:
    """One topic for one reader or writer: equal types would be merged, and closed together with the first one.

    Raises:
        LocalError: the binding's version is unknown.
    """

    def __init__(self, participant: DomainParticipant, name: str, type_name: str) -> None:
        # A separate class that shares what the binding computed, and never frees, for the first one of this type.
        own = type("Opaque", (), {"__idl__": _model(type_name).__idl__})
        self.topic = Topic(participant, name, own)
        self._length = _announcement_length(self.topic)
        self._full = self._length.value
        self._length.value = 0

    def close(self) -> None:
        """Free the topic; its reader or writer is closed already."""
        self._length.value = self._full  # otherwise the announcement is never freed
        del self.topic, self._length


@cache
def _model(type_name: str) -> type[IdlStruct]:
    return dataclasses.dataclass(types.new_class("Opaque", (IdlStruct,), {"typename": type_name}, _body))


def _body(space: dict[str, object]) -> None:
    space["__annotations__"] = {"octet": idl.uint8}


def _announcement_length(topic: Topic) -> ct.c_uint32:
    address = sertype_of(topic._ref)
    words = (ct.c_uint64 * _WORDS).from_address(address)
    at = next((at for at in range(_WORDS - _LENGTH_AT) if words[at] == id(topic.data_type)), None)
    if at is not None:
        length = ct.c_uint32.from_address(address + _WORD * (at + _LENGTH_AT))
        if length.value == len(topic.data_type.__idl__._xt_bytedata[0]):
            return length
    raise LocalError("this Cyclone DDS keeps its types in another way: install cyclonedds 11.0.1")
