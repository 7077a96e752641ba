"""QoS profiles in rclpy's form and in the proxy's, and the compatibility of an offer with a request.

Sans-I/O; the enumerations of rclpy are imported where they are used.
Source: DDS 1.4, section 2.2.3 (request against offer); rmw/types.h (the names of policies).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from proxy.endpoints.core.endpoint import Graph, GraphEntity, Role
from proxy.endpoints.core.qos import INFINITE_FROM_S
from proxy.serial.channel import Channel, Qos

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

_INFINITE: Final = (9_223_372_036, 854_775_807)  # RMW_DURATION_INFINITE
_DEPTH: Final = 10
_DEPTH_OF_ALL: Final = 1_000
_LIVELINESS: Final = ("automatic", "manual_by_topic")


def filled(qos: Qos | None, *, latched: bool = False) -> Qos:
    """Return a profile that an endpoint accepts: every policy has a definite value, the depth is finite.

    "Keep all" becomes a depth of 1,000: one stalled reader must not block the publisher for all others.

    Args:
        qos: None: reliable, and transient local with a depth of one if ``latched``.
    """
    if qos is None:
        durability, depth = ("transient_local", 1) if latched else ("volatile", _DEPTH)
        return Qos(
            depth=depth, reliability="reliable", durability=durability, deadline=(0, 0), lifespan=(0, 0), lease=(0, 0)
        )
    return Qos(
        depth=_DEPTH_OF_ALL if qos.history == "keep_all" else qos.depth or _DEPTH,
        reliability="best_effort" if qos.reliability == "best_effort" else "reliable",
        durability="transient_local" if qos.durability == "transient_local" else "volatile",
        deadline=_duration(qos.deadline),
        lifespan=_duration(qos.lifespan),
        liveliness="manual_by_topic" if qos.liveliness == "manual_by_topic" else "automatic",
        lease=_duration(qos.lease),
        plain_names=qos.plain_names,
    )


def conflict(offered: Qos, requested: Qos) -> str:
    """Return why a publisher's offer does not meet a subscription's request, empty where it does."""
    if (offered.reliability, requested.reliability) == ("best_effort", "reliable"):
        return "reliability: best effort offered, reliable requested"
    if (offered.durability, requested.durability) == ("volatile", "transient_local"):
        return "durability: volatile offered, transient local requested"
    if _limit(offered.deadline) > _limit(requested.deadline):
        return "deadline: a longer one offered than requested"
    if offered.liveliness in _LIVELINESS and requested.liveliness in _LIVELINESS:
        if _LIVELINESS.index(offered.liveliness) < _LIVELINESS.index(requested.liveliness):
            return "liveliness: automatic offered, manual by topic requested"
        if _limit(offered.lease) > _limit(requested.lease):
            return "liveliness: a longer lease offered than requested"
    return ""


def from_profile(profile: QoSProfile) -> Qos:
    """Return the proxy's form of rclpy's profile."""
    return Qos(
        history=profile.history.name.lower(),
        depth=profile.depth,
        reliability=profile.reliability.name.lower(),
        durability=profile.durability.name.lower(),
        deadline=_seconds(profile.deadline.nanoseconds),
        lifespan=_seconds(profile.lifespan.nanoseconds),
        liveliness=profile.liveliness.name.lower(),
        lease=_seconds(profile.liveliness_lease_duration.nanoseconds),
        plain_names=profile.avoid_ros_namespace_conventions,
    )


def to_profile(qos: Qos) -> QoSProfile:
    """Return rclpy's form of a ``filled`` profile."""
    from rclpy.duration import Duration
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=qos.depth,
        reliability=ReliabilityPolicy[qos.reliability.upper()],
        durability=DurabilityPolicy[qos.durability.upper()],
        deadline=Duration(seconds=qos.deadline[0], nanoseconds=qos.deadline[1]),
        lifespan=Duration(seconds=qos.lifespan[0], nanoseconds=qos.lifespan[1]),
        liveliness=LivelinessPolicy[qos.liveliness.upper()],
        liveliness_lease_duration=Duration(seconds=qos.lease[0], nanoseconds=qos.lease[1]),
        avoid_ros_namespace_conventions=qos.plain_names,
    )


def service_profile() -> QoSProfile:
    """Return the default profile of services with a larger depth, because a burst of calls must fit."""
    return to_profile(replace(filled(None), depth=_DEPTH_OF_ALL))


def _duration(duration: tuple[int, int]) -> tuple[int, int]:
    return (0, 0) if duration[0] >= INFINITE_FROM_S else duration


def _limit(duration: tuple[int, int]) -> tuple[int, int]:
    """Return the duration; zero means unspecified, which is infinite."""
    return _INFINITE if duration == (0, 0) or duration[0] >= INFINITE_FROM_S else duration


def _seconds(nanoseconds: int) -> tuple[int, int]:
    seconds, rest = divmod(nanoseconds, 1_000_000_000)
    return seconds, rest


def incompatibility(role: Role, channel: Channel, qos: Qos, ends: Graph) -> str:
    """Return why some entity of the opposite role cannot be matched, empty where all can.

    Args:
        ends: the other entities of the topic; those of the same role are ignored.
    """
    for end in sorted((end for end in ends if end.role is not role), key=lambda end: (end.node, end.key)):
        reason = _type_conflict(channel, end) or _qos_conflict(role, qos, end)
        if reason:
            return f"{channel.topic}: {end.node} {end.role.value} it with {reason}"
    return ""


def _type_conflict(channel: Channel, end: GraphEntity) -> str:
    if end.type_name != channel.type_name:
        return f"another type, {end.type_name} and not {channel.type_name}"
    if end.hash and channel.hash and end.hash != channel.hash:
        return f"another definition of {end.type_name}, {end.hash[:15]} and not {channel.hash[:15]}"
    return ""


def _qos_conflict(role: Role, qos: Qos, end: GraphEntity) -> str:
    if end.qos is None:
        return ""
    reason = conflict(qos, end.qos) if role is Role.PUBLISHES else conflict(end.qos, qos)
    return f"a QoS that does not fit ours ({reason})" if reason else ""
