"""What is wrong between an end of ours and the others of its topic, in one sentence.

Place: pure.
"""

from __future__ import annotations

from proxy.endpoints.endpoint import Graph, GraphEntity, Role
from proxy.endpoints.ros2.qos import conflict
from proxy.serial.channel import Channel, Qos

__all__ = ["incompatibility"]


def incompatibility(role: Role, channel: Channel, qos: Qos, ends: Graph) -> str:
    """Return why some end on the other side of the topic cannot be reached or read, empty where all can.

    Args:
        role: ours, PUBLISHES or SUBSCRIBES.
        channel: ours.
        qos: what we offer or request.
        ends: the others in the topic; those of our own role do not matter.
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
