"""Channels of a recording: conversion from rosbags' connections."""

from __future__ import annotations

import re
from collections.abc import Sequence

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    ConnectionExtRosbag2,
    MessageDefinitionFormat,
    QosDurability,
)
from rosbags.interfaces import Qos as RosbagsQos
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import parse_qos
from ruamel.yaml.error import YAMLError

from gdp.errors import LocalError
from gdp.ros_names import resolved
from proxy.recordings.plain_yaml import load_plain
from proxy.recordings.unpacking import SalvageError
from proxy.serial.channel import Channel, DefinitionFormat, Qos
from proxy.serial.standard_types import standard_definition, type_hash

_QOS_TEXT_MAX = 64 << 10

_RENAMED = {  # types of equal definition: by the old name and the md5 sum
    ("tf/msg/tfMessage", "94810edda583a504dfda3829e70d7eec"): "tf2_msgs/msg/TFMessage",
}
_FORMATS: dict[MessageDefinitionFormat, DefinitionFormat] = {
    MessageDefinitionFormat.MSG: "msg",
    MessageDefinitionFormat.IDL: "idl",
    MessageDefinitionFormat.NONE: "",
}


def from_connection(connection: Connection) -> Channel:
    """Return the channel of one of rosbags' connections. Raises ``LocalError``: its messages are not CDR."""
    extra = connection.ext
    definition_format = _FORMATS[connection.msgdef.format]
    if isinstance(extra, ConnectionExtRosbag1):
        return from_ros1(
            connection.topic,
            connection.msgtype,
            connection.digest,
            connection.msgdef.data,
            definition_format,
            latched=bool(extra.latching),
            callerid=extra.callerid,
        )
    if not isinstance(extra, ConnectionExtRosbag2) or extra.serialization_format != "cdr":
        raise LocalError(f"topic {connection.topic} is not in CDR")
    return from_ros2(
        connection.topic,
        connection.msgtype,
        connection.digest,
        connection.msgdef.data,
        definition_format,
        extra.offered_qos_profiles,
    )


def from_ros1(
    topic: str,
    type_name: str,
    md5: str,
    definition: str,
    definition_format: DefinitionFormat,
    *,
    latched: bool,
    callerid: str | None,
) -> Channel:
    """Return a ROS 1 channel; the topic gets its full name, a type that was renamed since its present one."""
    return Channel(
        topic=resolved(topic),
        type_name=_RENAMED.get((type_name, md5), type_name),
        ros=1,
        hash=md5,
        definition=definition,
        definition_format=definition_format,
        latched=latched,
        callerid=callerid,
    )


def from_ros2(
    topic: str,
    type_name: str,
    digest: str,
    definition: str,
    definition_format: DefinitionFormat,
    profiles: Sequence[RosbagsQos],
) -> Channel:
    """Return a ROS 2 channel, with the standard definition and the hash filled in where the recording has none.

    The topic gets its full name, the type its name in ROS 2.
    """
    topic, type_name = resolved(topic), ros2_type(type_name)
    if not definition_format:
        standard = standard_definition(type_name)
        if standard is not None:
            definition, definition_format = standard, "msg"
    return Channel(
        topic=topic,
        type_name=type_name,
        ros=2,
        hash=digest or type_hash(type_name, definition, definition_format),
        definition=definition,
        definition_format=definition_format,
        qos=tuple(_from_qos(profile) for profile in profiles),
        latched=any(profile.durability is QosDurability.TRANSIENT_LOCAL for profile in profiles),
    )


def ros2_type(name: str) -> str:
    """Return a message type as ROS 2 writes it, where DDS (``a::msg::B``, ``a::msg::dds_::B_``) or ROS 1 wrote it."""
    parts = re.split("::|/", name)
    if "dds_" in parts:
        parts = [part.removesuffix("_") for part in parts if part != "dds_"]
    if len(parts) == 2:
        parts.insert(1, "msg")
    return "/".join(parts)


def offered_qos(topic: str, text: str, lacking: list[str]) -> list[RosbagsQos]:
    """Return the QoS profiles that a recording states as offered; what cannot be read adds a line to ``lacking``."""
    try:
        if len(text) > _QOS_TEXT_MAX:
            raise SalvageError(f"{len(text)} characters")
        return parse_qos(load_plain(text))  # type: ignore[arg-type]
    except (LocalError, ReaderError, YAMLError, ArithmeticError, AttributeError, RecursionError) as error:
        why = str(error) or type(error).__name__
    except (AssertionError, TypeError, ValueError, LookupError) as error:
        why = f"{type(error).__name__}: {error}"
    lacking.append(f"topic {topic} is given without its QoS, which cannot be read ({' '.join(why.split())[:200]})")
    return []


def _from_qos(profile: RosbagsQos) -> Qos:
    return Qos(
        history=profile.history.name.lower(),
        depth=profile.depth,
        reliability=profile.reliability.name.lower(),
        durability=profile.durability.name.lower(),
        deadline=(profile.deadline.sec, profile.deadline.nsec),
        lifespan=(profile.lifespan.sec, profile.lifespan.nsec),
        liveliness=profile.liveliness.name.lower(),
        lease=(profile.liveliness_lease_duration.sec, profile.liveliness_lease_duration.nsec),
        plain_names=profile.avoid_ros_namespace_conventions,
    )
