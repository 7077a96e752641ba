"""Policies that a peer announces for one of its entities: its QoS profile and its user data.

I/O. The binding reads policies into variables that all threads share, and never frees user data. So these few are read
from the C structure directly.
"""

from __future__ import annotations

import ctypes as ct
from typing import Final, NamedTuple

from cyclonedds.__library__ import library_path

from proxy.serial.channel import NEVER, Qos

_SECOND: Final = 1_000_000_000
_FOREVER: Final = (1 << 63) - 1
_LIVELINESS: Final = ("automatic", "manual_by_participant", "manual_by_topic")

_library = ct.CDLL(str(library_path))
_free = _library.dds_free
_free.argtypes = (ct.c_void_p,)
_free.restype = None


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
