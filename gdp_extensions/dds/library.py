"""Library bindings for a few functions of Cyclone DDS that the Python binding lacks, or offers in an unsuitable form.

I/O. ``ddspy_write`` of the binding blocks all of Python while it writes; its ``WaitSet.wait`` does not report which
condition holds.
"""

from __future__ import annotations

import ctypes as ct
from collections.abc import Sequence
from typing import Final

from cyclonedds.__library__ import library_path

from gdp.errors import LocalError

TIMED_OUT: Final = -10  # DDS_RETCODE_TIMEOUT
_TRIGGERED_MAX: Final = 256
_FOREVER: Final = (1 << 63) - 1

# a separate handle: argument types set here must not change those of the binding
_library = ct.CDLL(str(library_path))


class _Sample(ct.Structure):
    """Input structure of the binding's serialiser."""

    _fields_ = (("raw", ct.c_char_p), ("size", ct.c_size_t))


_write = _library.dds_write
_write.argtypes = (ct.c_int32, ct.POINTER(_Sample))
_get_sertype = _library.dds_get_entity_sertype
_get_sertype.argtypes = (ct.c_int32, ct.POINTER(ct.c_void_p))
_create = _library.dds_create_waitset
_create.argtypes = (ct.c_int32,)
_attach = _library.dds_waitset_attach
_attach.argtypes = (ct.c_int32, ct.c_int32, ct.c_ssize_t)
_detach = _library.dds_waitset_detach
_detach.argtypes = (ct.c_int32, ct.c_int32)
_wait = _library.dds_waitset_wait
_wait.argtypes = (ct.c_int32, ct.POINTER(ct.c_ssize_t), ct.c_size_t, ct.c_int64)
_delete = _library.dds_delete
_delete.argtypes = (ct.c_int32,)
_take_status = _library.dds_take_status
_take_status.argtypes = (ct.c_int32, ct.POINTER(ct.c_uint32), ct.c_uint32)
_readers = _library.dds_get_matched_subscriptions
_writers = _library.dds_get_matched_publications
for _matched in (_readers, _writers):
    _matched.argtypes = (ct.c_int32, ct.POINTER(ct.c_uint64), ct.c_size_t)


def write(writer: int, raw: bytes) -> int:
    """Write CDR bytes with their encapsulation; return 0, or a negative code.

    ``raw`` is a whole number of words: DDS pads each payload, and the binding does not.
    """
    return int(_write(writer, ct.byref(_Sample(raw, len(raw)))))


def count_readers(writer: int) -> int:
    """Return the number of matched readers of a writer."""
    return max(int(_readers(writer, None, 0)), 0)


def count_writers(reader: int) -> int:
    """Return the number of matched writers of a reader."""
    return max(int(_writers(reader, None, 0)), 0)


def matched_readers(writer: int) -> Sequence[int]:
    """Return the instance handles of a writer's matched readers."""
    capacity = count_readers(writer)
    found = (ct.c_uint64 * capacity)()
    return found[: min(max(int(_readers(writer, found, capacity)), 0), capacity)] if capacity else ()


def matches(entity: int, status: int) -> None:
    """Reset the status that signals a change of a reader's or writer's matches."""
    _take_status(entity, ct.byref(ct.c_uint32()), status)


def sertype_of(topic: int) -> int:
    """Return the address of the C description of a topic's type.

    Raises:
        LocalError: the library does not give it.
    """
    found = ct.c_void_p()
    if _get_sertype(topic, ct.byref(found)) < 0 or found.value is None:
        raise LocalError("Cyclone DDS does not show its types: this needs cyclonedds 11.0.1")
    return found.value


class WaitSet:
    """Conditions, each with an identifying number."""

    def __init__(self, participant: int) -> None:
        self._ref = int(_create(participant))
        self._triggered = (ct.c_ssize_t * _TRIGGERED_MAX)()
        if self._ref < 0:
            raise LocalError(f"Cyclone DDS gives no wait set (code {self._ref})")

    def attach(self, entity: int, number: int) -> None:
        """Add a condition."""
        code = _attach(self._ref, entity, number)
        if code < 0:
            raise LocalError(f"Cyclone DDS cannot wait for an entity (code {code})")

    def detach(self, entity: int) -> None:
        """Remove a condition."""
        _detach(self._ref, entity)

    def wait(self) -> list[int]:
        """Block until a condition holds; return the numbers of all that hold, smallest first."""
        found = int(_wait(self._ref, self._triggered, _TRIGGERED_MAX, _FOREVER))
        return sorted(self._triggered[: min(max(found, 0), _TRIGGERED_MAX)])

    def delete(self) -> None:
        """Free the wait set; no thread may wait on it any more."""
        _delete(self._ref)
