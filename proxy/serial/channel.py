"""Channel: description of a topic's messages for a reader; it travels sealed, once per reader. A service has two.

Sans-I/O. The wire form is a bounded CBOR map with one-letter keys; a malformed one is refused as a whole.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, astuple, dataclass, fields
from typing import Annotated, Any, Final, Literal, TypeAlias

from gdp.crypto.schema import FLAG, OCTETS, FieldSet, Form, Keyed, literal, many, mapped, row, text, uint
from gdp.errors import DropReason, LocalError, RemoteError, StatementError
from proxy.serial.schema import DEFINITION_MAX_BYTES, definition_bytes

RosVersion: TypeAlias = Literal[1, 2]
DefinitionFormat: TypeAlias = Literal["msg", "idl", ""]

EMPTY_MD5: Final = "d41d8cd98f00b204e9800998ecf8427e"  # of a ROS 1 type without fields and constants
NEVER: Final = (9_223_372_036, 854_775_807)  # ROS 2's form of an infinite duration
CHANNEL_MAX_BYTES: Final = 128 << 10
QOS_MAX: Final = 64


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


def _values(*each: Any) -> tuple[Any, ...]:
    return each


def _qos(values: tuple[Any, ...]) -> Qos:
    return Qos(**{each.name: value for each, value in zip(fields(Qos), values, strict=True)})


def _bounded(definition: str) -> str:
    if definition_bytes(definition) > DEFINITION_MAX_BYTES:
        raise ValueError(f"a definition of more than {DEFINITION_MAX_BYTES} bytes")
    return definition


TEXT: Final = text(1_024)
_WHOLE: Final = uint(1 << 63)
_DURATION: Final[Form[tuple[int, int]]] = row(_values, _WHOLE, _WHOLE)
_PROFILE: Final = (TEXT, _WHOLE, TEXT, TEXT, _DURATION, _DURATION, TEXT, _DURATION, FLAG)
_QOS: Final = mapped(row(_values, *_PROFILE), _qos, astuple)
_ROS: Final[Form[RosVersion]] = literal(1, 2)
_FORMAT: Final[Form[DefinitionFormat]] = literal("msg", "idl", "")
_DEFINITION: Final = mapped(text(DEFINITION_MAX_BYTES), _bounded, str)


@dataclass(frozen=True, slots=True)
class Channel(FieldSet):
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

    MAX_BYTES = CHANNEL_MAX_BYTES
    topic: Annotated[str, Keyed("t", TEXT)]
    type_name: Annotated[str, Keyed("n", TEXT)]
    ros: Annotated[RosVersion, Keyed("r", _ROS)]
    _: KW_ONLY
    hash: Annotated[str, Keyed("h", TEXT)] = ""
    definition: Annotated[str, Keyed("d", _DEFINITION)] = ""
    definition_format: Annotated[DefinitionFormat, Keyed("f", _FORMAT)] = ""
    qos: Annotated[tuple[Qos, ...], Keyed("q", many(_QOS, QOS_MAX, is_cut=False), absent=(), is_omitted=True)] = ()
    latched: Annotated[bool, Keyed("l", FLAG)] = False
    callerid: Annotated[str | None, Keyed("c", TEXT, absent=None, is_omitted=True)] = None

    def to_wire(self) -> bytes:
        """Return the bounded CBOR form. Raises ``LocalError``: a part is longer than a peer would accept."""
        wire = self.to_cbor()
        try:
            Channel.from_cbor(wire)
        except RemoteError as error:
            raise LocalError(f"{self.topic}: cannot be described to a reader: {error.detail}") from error
        return wire


CHANNEL: Final = mapped(OCTETS, Channel.from_cbor, Channel.to_wire)


def ros1_format(text: str, md5: str) -> DefinitionFormat:
    """Return the format of a ROS 1 definition: an empty text is one where the md5 sum says that there are no fields."""
    return "msg" if text or md5 == EMPTY_MD5 else ""


@dataclass(frozen=True, slots=True)
class Service(FieldSet):
    """A service.

    Args:
        type_name: as ROS 2 writes it (``std_srvs/srv/SetBool``), for ROS 1 too.
        hash: md5 sum of the ROS 1 service, ``RIHS01_...`` for ROS 2; empty where unknown.
        request: of type ``std_srvs/srv/SetBool_Request``, for ROS 1 too; its ``topic`` is the service's name.
        response: of type ``std_srvs/srv/SetBool_Response``.
    """

    MAX_BYTES = 2 * CHANNEL_MAX_BYTES + 4_096
    name: Annotated[str, Keyed("n", TEXT)]
    type_name: Annotated[str, Keyed("t", TEXT)]
    hash: Annotated[str, Keyed("h", TEXT)]
    request: Annotated[Channel, Keyed("q", CHANNEL)]
    response: Annotated[Channel, Keyed("r", CHANNEL)]

    @property
    def ros(self) -> RosVersion:
        """Return the ROS version of the messages' wire form."""
        return self.request.ros

    def check(self) -> None:
        """Return if both parts are of one ROS. Raises ``StatementError``: MALFORMED."""
        if self.request.ros != self.response.ros:
            raise StatementError(DropReason.MALFORMED, "a service description")


SERVICE: Final = mapped(OCTETS, Service.from_cbor, Service.to_cbor)
