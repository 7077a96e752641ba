"""Channel: description of a topic's messages for a reader; it travels sealed, once per reader.

Sans-I/O. The wire form is a bounded CBOR map with one-letter keys; a malformed one is refused as a whole.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, astuple, dataclass
from typing import Final, Literal, TypeAlias

import cbor2

from gdp.errors import DropReason, LocalError, RemoteError
from proxy.serial.cbor_bounds import check_bounds
from proxy.serial.schema import DEFINITION_MAX_BYTES, definition_bytes

__all__ = ["EMPTY_MD5", "NEVER", "QOS_MAX", "Channel", "DefinitionFormat", "Qos", "RosVersion", "ros1_format"]

RosVersion: TypeAlias = Literal[1, 2]
DefinitionFormat: TypeAlias = Literal["msg", "idl", ""]

EMPTY_MD5: Final = "d41d8cd98f00b204e9800998ecf8427e"  # of a ROS 1 type without fields and constants
NEVER: Final = (9_223_372_036, 854_775_807)  # ROS 2's form of an infinite duration
_ITEMS_MAX: Final = 4_096
CHANNEL_MAX_BYTES: Final = 128 << 10
_TEXT_MAX: Final = 1024
QOS_MAX: Final = 64
_TIME_MAX: Final = 1 << 63


@dataclass(frozen=True, slots=True, kw_only=True)
class Qos:
    """One offered QoS profile. Policies have ROS 2's names in lower case; durations are (seconds, nanoseconds)."""

    history: str = "keep_last"
    depth: int
    reliability: str
    durability: str
    deadline: tuple[int, int] = NEVER
    lifespan: tuple[int, int] = NEVER
    liveliness: str = "automatic"
    lease: tuple[int, int] = NEVER
    plain_names: bool = False  # avoid_ros_namespace_conventions


@dataclass(frozen=True, slots=True)
class Channel:
    """One publisher's topic, or one topic of a recording.

    Args:
        type_name: as ROS 2 writes it (``sensor_msgs/msg/Image``), for ROS 1 too.
        hash: md5 sum for ROS 1, ``RIHS01_...`` for ROS 2; empty where unknown.
        definition: full text, used types included; empty for a type without fields.
        definition_format: of ``definition``; empty where the definition is unknown.
        qos: offered profiles, ROS 2 only.
        latched: late joiners get the last message.
        callerid: the publishing node, ROS 1 only, where known.
    """

    topic: str
    type_name: str
    ros: RosVersion
    _: KW_ONLY
    hash: str = ""
    definition: str = ""
    definition_format: DefinitionFormat = ""
    qos: tuple[Qos, ...] = ()
    latched: bool = False
    callerid: str | None = None

    def to_wire(self) -> bytes:
        """Return the bounded CBOR form.

        Raises:
            LocalError: a part is longer than a peer would accept.
        """
        fields: dict[str, object] = {
            "t": self.topic,
            "n": self.type_name,
            "r": self.ros,
            "h": self.hash,
            "d": self.definition,
            "f": self.definition_format,
            "l": self.latched,
        }
        if self.qos:
            fields["q"] = [astuple(profile) for profile in self.qos]
        if self.callerid is not None:
            fields["c"] = self.callerid
        wire = cbor2.dumps(fields, canonical=True)
        try:
            Channel.from_wire(wire)
        except RemoteError as error:
            raise LocalError(f"{self.topic}: cannot be described to a reader: {error.detail}") from error
        return wire

    @classmethod
    def from_wire(cls, wire: bytes) -> Channel:
        """Parse the form that ``to_wire`` writes.

        Raises:
            RemoteError: any other bytes.
        """
        if len(wire) > CHANNEL_MAX_BYTES:
            raise RemoteError(DropReason.MALFORMED, f"a description of {len(wire)} bytes")
        try:
            check_bounds(wire, _ITEMS_MAX)
            fields = cbor2.loads(wire)
        except (cbor2.CBORDecodeError, RecursionError, ValueError, TypeError, OverflowError) as error:
            raise RemoteError(DropReason.MALFORMED, "a description that is not CBOR") from error
        if not isinstance(fields, dict):
            raise RemoteError(DropReason.MALFORMED, "a description that is not a map")
        ros = _whole(fields.get("r"))
        definition_format = _text(fields.get("f"))
        if ros not in (1, 2) or definition_format not in ("msg", "idl", ""):
            raise RemoteError(DropReason.MALFORMED, "a description of another ROS or form")
        profiles = fields.get("q", [])
        if not isinstance(profiles, list) or len(profiles) > QOS_MAX:
            raise RemoteError(DropReason.MALFORMED, "QoS profiles")
        callerid = fields.get("c")
        return cls(
            topic=_text(fields.get("t")),
            type_name=_text(fields.get("n")),
            ros=1 if ros == 1 else 2,
            hash=_text(fields.get("h")),
            definition=_definition(fields.get("d")),
            definition_format="msg" if definition_format == "msg" else "idl" if definition_format == "idl" else "",
            qos=tuple(_qos(profile) for profile in profiles),
            latched=_flag(fields.get("l")),
            callerid=None if callerid is None else _text(callerid),
        )


def ros1_format(text: str, md5: str) -> DefinitionFormat:
    """Return the format of a ROS 1 definition: an empty text is one where the md5 sum says that there are no fields."""
    return "msg" if text or md5 == EMPTY_MD5 else ""


def _qos(fields: object) -> Qos:
    if not isinstance(fields, list) or len(fields) != 9:
        raise RemoteError(DropReason.MALFORMED, "a QoS profile")
    return Qos(
        history=_text(fields[0]),
        depth=_whole(fields[1]),
        reliability=_text(fields[2]),
        durability=_text(fields[3]),
        deadline=_duration(fields[4]),
        lifespan=_duration(fields[5]),
        liveliness=_text(fields[6]),
        lease=_duration(fields[7]),
        plain_names=_flag(fields[8]),
    )


def _text(value: object, limit: int = _TEXT_MAX) -> str:
    if not isinstance(value, str) or len(value) > limit:
        raise RemoteError(DropReason.MALFORMED, f"a text of at most {limit} characters was expected")
    return value


def _definition(value: object) -> str:
    definition = _text(value, DEFINITION_MAX_BYTES)
    if definition_bytes(definition) > DEFINITION_MAX_BYTES:
        raise RemoteError(DropReason.MALFORMED, f"a definition of more than {DEFINITION_MAX_BYTES} bytes")
    return definition


def _whole(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= _TIME_MAX:
        raise RemoteError(DropReason.MALFORMED, "a whole number was expected")
    return value


def _flag(value: object) -> bool:
    if not isinstance(value, bool):
        raise RemoteError(DropReason.MALFORMED, "true or false was expected")
    return value


def _duration(value: object) -> tuple[int, int]:
    if not isinstance(value, list) or len(value) != 2:
        raise RemoteError(DropReason.MALFORMED, "a duration was expected")
    return _whole(value[0]), _whole(value[1])
