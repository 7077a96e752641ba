"""QoS compatibility of one of the endpoint's entities with the others of its topic, as one sentence.

Sans-I/O.
"""

from __future__ import annotations

from proxy.endpoints.endpoint import Graph, GraphEntity, Role
from proxy.endpoints.ros2.qos import conflict
from proxy.serial.channel import Channel, Qos

__all__ = ["incompatibility"]


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
