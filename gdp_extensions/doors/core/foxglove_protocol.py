"""Foxglove WebSocket protocol, version 1: messages of the server, and the parser of those of a client.

Sans-I/O. Source: the protocol ``foxglove.websocket.v1`` of the repository ws-protocol; the Foxglove SDK calls the same
messages ``foxglove.sdk.v1``. Numbers in binary messages are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import orjson

from gdp.ros_names import resolved
from gdp_extensions.doors.core.client_fields import word, wrong
from proxy.serial.channel import Channel, Service

SUBPROTOCOLS: Final = ("foxglove.websocket.v1", "foxglove.sdk.v1")
INFO, WARNING, ERROR = 0, 1, 2  # levels of a status
_CAPABILITIES: Final = ("clientPublish", "parameters", "services")
_ENCODING: Final = "cdr"
_SCHEMA_ENCODINGS: Final = {"msg": "ros2msg", "idl": "ros2idl", "": "ros2msg"}
_LIST_MAX: Final = 4_096
_TEXT_MAX: Final = 1_024
_SCHEMA_MAX: Final = 1 << 20
_MESSAGE: Final = struct.Struct("<BIQ")  # opcode, subscription, time in ns
_RESPONSE: Final = struct.Struct("<BIII")  # opcode, service, call, length of the encoding's name
_CLIENT_MESSAGE: Final = struct.Struct("<BI")
_U32: Final = (1 << 32) - 1


@dataclass(frozen=True, slots=True)
class Subscription:
    """A client's subscription: its number, and the channel."""

    number: int
    channel: int


@dataclass(frozen=True, slots=True)
class SubscribeChannels:
    """``subscribe``."""

    subscriptions: tuple[Subscription, ...]


@dataclass(frozen=True, slots=True)
class UnsubscribeChannels:
    """``unsubscribe``."""

    numbers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ClientChannel:
    """A topic that a client publishes; the schema is empty where the client gives none."""

    number: int
    topic: str
    encoding: str
    type_name: str
    schema: str
    schema_encoding: str


@dataclass(frozen=True, slots=True)
class AdvertiseChannels:
    """``advertise`` of a client."""

    channels: tuple[ClientChannel, ...]


@dataclass(frozen=True, slots=True)
class UnadvertiseChannels:
    """``unadvertise`` of a client."""

    numbers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class PublishMessage:
    """Binary message of a client's channel."""

    channel: int
    raw: bytes


@dataclass(frozen=True, slots=True)
class CallService:
    """Binary service call."""

    service: int
    call: int
    encoding: str
    raw: bytes


@dataclass(frozen=True, slots=True)
class GetParameters:
    """``getParameters``; without names: all."""

    names: tuple[str, ...]
    number: str | None


@dataclass(frozen=True, slots=True)
class SetParameters:
    """``setParameters``; each has ``name``, ``value`` and perhaps ``type``."""

    parameters: tuple[dict[str, object], ...]
    number: str | None


ClientMessage: TypeAlias = (
    SubscribeChannels
    | UnsubscribeChannels
    | AdvertiseChannels
    | UnadvertiseChannels
    | PublishMessage
    | CallService
    | GetParameters
    | SetParameters
)


def server_info(name: str, session: str) -> str:
    """Return ``serverInfo``, the first message of a connection."""
    return _text(
        op="serverInfo",
        name=name,
        capabilities=_CAPABILITIES,
        supportedEncodings=[_ENCODING],
        metadata={},
        sessionId=session,
    )


def status(level: int, message: str, number: str | None = None) -> str:
    """Return ``status``; one with the same number replaces the earlier one."""
    return _text(op="status", level=level, message=message, **({} if number is None else {"id": number}))


def advertise(channels: Sequence[tuple[int, Channel]]) -> str:
    """Return ``advertise`` of numbered channels, each with its full definition."""
    shown = [
        {
            "id": number,
            "topic": channel.topic,
            "encoding": _ENCODING,
            "schemaName": channel.type_name,
            "schema": channel.definition,
            "schemaEncoding": _SCHEMA_ENCODINGS[channel.definition_format],
        }
        for number, channel in channels
    ]
    return _text(op="advertise", channels=shown)


def unadvertise(numbers: Sequence[int]) -> str:
    """Return ``unadvertise``."""
    return _text(op="unadvertise", channelIds=list(numbers))


def advertise_services(services: Sequence[tuple[int, Service]]) -> str:
    """Return ``advertiseServices`` of numbered services."""
    shown = [
        {
            "id": number,
            "name": service.name,
            "type": service.type_name,
            "request": _half(service.request),
            "response": _half(service.response),
            "requestSchema": service.request.definition,
            "responseSchema": service.response.definition,
        }
        for number, service in services
    ]
    return _text(op="advertiseServices", services=shown)


def unadvertise_services(numbers: Sequence[int]) -> str:
    """Return ``unadvertiseServices``."""
    return _text(op="unadvertiseServices", serviceIds=list(numbers))


def service_failure(service: int, call: int, reason: str) -> str:
    """Return ``serviceCallFailure``."""
    return _text(op="serviceCallFailure", serviceId=service, callId=call, message=reason)


def parameter_values(parameters: Sequence[dict[str, object]], number: str | None) -> str:
    """Return ``parameterValues``, the answer to the request of this number."""
    return _text(op="parameterValues", parameters=list(parameters), **({} if number is None else {"id": number}))


def message_data(subscription: int, stamp_ns: int, raw: bytes) -> bytes:
    """Return one message of a subscription; ``stamp_ns``: wall clock."""
    return b"".join((_MESSAGE.pack(1, subscription, stamp_ns), raw))


def service_response(service: int, call: int, raw: bytes) -> bytes:
    """Return the response of a call."""
    return b"".join((_RESPONSE.pack(3, service, call, len(_ENCODING)), _ENCODING.encode(), raw))


def parse(data: str | bytes) -> ClientMessage:
    """Return a client's message.

    Raises:
        RemoteError: it is malformed, or of an operation that this server does not announce.
    """
    return _parse_binary(data) if isinstance(data, bytes) else _parse_text(data)


def _parse_binary(data: bytes) -> ClientMessage:
    if data[:1] == b"\1" and len(data) >= _CLIENT_MESSAGE.size:
        return PublishMessage(_CLIENT_MESSAGE.unpack_from(data)[1], data[_CLIENT_MESSAGE.size :])
    if data[:1] == b"\2" and len(data) >= _RESPONSE.size:
        _, service, call, size = _RESPONSE.unpack_from(data)
        begin = _RESPONSE.size + size
        if size <= _TEXT_MAX and begin <= len(data):
            encoding = data[_RESPONSE.size : begin].decode("ascii", errors="replace")
            return CallService(service, call, encoding, data[begin:])
    raise wrong("a binary message that is neither a message nor a service call")


def _parse_text(data: str) -> ClientMessage:
    try:
        fields = orjson.loads(data)
    except orjson.JSONDecodeError as error:
        raise wrong("a text that is not JSON") from error
    operation = fields.get("op") if isinstance(fields, dict) else None
    match operation:
        case "subscribe":
            return SubscribeChannels(
                tuple(
                    Subscription(_u32(each, "id"), _u32(each, "channelId")) for each in _maps(fields, "subscriptions")
                )
            )
        case "unsubscribe":
            return UnsubscribeChannels(_numbers(fields, "subscriptionIds"))
        case "advertise":
            return AdvertiseChannels(tuple(map(_client_channel, _maps(fields, "channels"))))
        case "unadvertise":
            return UnadvertiseChannels(_numbers(fields, "channelIds"))
        case "getParameters":
            names = fields.get("parameterNames")
            if not isinstance(names, list) or len(names) > _LIST_MAX:
                raise wrong(f"parameterNames: a list of at most {_LIST_MAX} texts was expected")
            return GetParameters(tuple(word({"name": name}, "name") for name in names), _id(fields))
        case "setParameters":
            return SetParameters(tuple(_maps(fields, "parameters")), _id(fields))
    raise wrong(f"operation {operation!r}, which this server does not announce"[:200])


def _client_channel(fields: dict[str, object]) -> ClientChannel:
    return ClientChannel(
        number=_u32(fields, "id"),
        topic=resolved(word(fields, "topic")),
        encoding=word(fields, "encoding"),
        type_name=word(fields, "schemaName"),
        schema=word(fields, "schema", _SCHEMA_MAX, is_optional=True),
        schema_encoding=word(fields, "schemaEncoding", is_optional=True),
    )


def _id(fields: dict[str, object]) -> str | None:
    return word(fields, "id") if fields.get("id") is not None else None


def _half(channel: Channel) -> dict[str, str]:
    return {
        "encoding": _ENCODING,
        "schemaName": channel.type_name,
        "schemaEncoding": _SCHEMA_ENCODINGS[channel.definition_format],
        "schema": channel.definition,
    }


def _text(**fields: object) -> str:
    return orjson.dumps(fields).decode()


def _maps(fields: dict[str, object], key: str) -> list[dict[str, object]]:
    items = fields.get(key)
    if not isinstance(items, list) or len(items) > _LIST_MAX:
        raise wrong(f"{key}: a list of at most {_LIST_MAX} items was expected")
    maps = [item for item in items if isinstance(item, dict)]
    if len(maps) < len(items):
        raise wrong(f"{key}: objects were expected")
    return maps


def _numbers(fields: dict[str, object], key: str) -> tuple[int, ...]:
    items = fields.get(key)
    if not isinstance(items, list) or len(items) > _LIST_MAX:
        raise wrong(f"{key}: a list of at most {_LIST_MAX} numbers was expected")
    return tuple(_u32({key: item}, key) for item in items)


def _u32(fields: dict[str, object], key: str) -> int:
    value = fields.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= _U32:
        raise wrong(f"{key}: a whole number of 32 bits was expected")
    return value
