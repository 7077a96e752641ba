"""Raw ROS 1 classes: the right names and md5 sums, with uninterpreted bytes. Only the rospy process imports this.

Imports genpy and genmsg. Remote definitions are parsed, never generated into code and never executed.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol, cast

import genmsg
import genpy
import roslib.message

from gdp.errors import LocalError
from proxy.serial.channel import Channel, Service

_RULE: Final = "\n" + "=" * 80 + "\n"
_WITH_FOLDER: Final = re.compile(r"\b([A-Za-z]\w*)/msg/([A-Za-z]\w*)")


class Raw(Protocol):
    """A message of a raw class, or an ``AnyMsg``."""

    _buff: bytes
    _connection_header: dict[str, str]


@dataclass(frozen=True, slots=True)
class KnownMessage:
    """A message type. ``name``: in ROS 1's form (``sensor_msgs/Image``)."""

    name: str
    md5: str
    text: str


@dataclass(frozen=True, slots=True)
class KnownService:
    """A service type; without texts where only its md5 sum is known."""

    name: str
    md5: str
    request: KnownMessage
    response: KnownMessage


def ros1_name(type_name: str) -> str:
    """Return ``sensor_msgs/Image`` for ``sensor_msgs/msg/Image``, and likewise for services."""
    return type_name.replace("/msg/", "/").replace("/srv/", "/")


def ros2_name(type_name: str, kind: str) -> str:
    """Return ``sensor_msgs/msg/Image`` for ``sensor_msgs/Image``; ``kind`` is ``msg`` or ``srv``."""
    package, _, base = type_name.partition("/")
    return f"{package}/{kind}/{base}"


def installed_message(type_name: str) -> KnownMessage | None:
    """Return an installed ROS 1 package's description of a type."""
    name = ros1_name(type_name)
    try:
        known = roslib.message.get_message_class(name)
    except ValueError:
        return None
    return None if known is None else KnownMessage(name, known._md5sum, known._full_text)


def installed_service(type_name: str) -> KnownService | None:
    """Return an installed ROS 1 package's description of a service type."""
    name = ros1_name(type_name)
    try:
        known = roslib.message.get_service_class(name)
    except ValueError:
        return None
    if known is None:
        return None
    request, response = known._request_class, known._response_class
    return KnownService(
        name,
        known._md5sum,
        KnownMessage(request._type, request._md5sum, request._full_text),
        KnownMessage(response._type, response._md5sum, response._full_text),
    )


def known_message(channel: Channel) -> KnownMessage:
    """Return the type of a channel, from its description or an installed package.

    Raises:
        LocalError: neither suffices, or they contradict each other.
    """
    name = ros1_name(channel.type_name)
    installed = installed_message(name)
    md5, text = channel.hash if channel.ros == 1 else "", channel.definition
    if not md5 and channel.ros == 1 and (text or installed is None):
        if not channel.definition_format:
            raise LocalError(f"{channel.type_name} is not known here: install its ROS 1 package")
        md5 = _md5((name, text))
    if installed is None:
        if not md5:
            raise LocalError(f"{channel.type_name} is not known here as a ROS 1 type: install its ROS 1 package")
        return KnownMessage(name, md5, text)
    if md5 and md5 != installed.md5:
        raise LocalError(
            f"{channel.type_name}: its publisher's definition has md5 {md5}, the installed one {installed.md5}"
        )
    return installed


def known_service(service: Service) -> KnownService:
    """Return the type of a service, from its description or an installed package."""
    installed = installed_service(service.type_name)
    name = ros1_name(service.type_name)
    request, response = f"{name}Request", f"{name}Response"
    md5 = service.hash if service.ros == 1 else ""
    if not md5 and service.ros == 1 and installed is None:
        md5 = _md5((request, service.request.definition), (response, service.response.definition))
    if installed is None:
        if not md5:
            raise LocalError(f"{service.type_name} is not known here as a ROS 1 type: install its ROS 1 package")
        return KnownService(name, md5, KnownMessage(request, md5, ""), KnownMessage(response, md5, ""))
    if md5 and md5 != installed.md5:
        raise LocalError(
            f"{service.type_name}: its server's definition has md5 {md5}, the installed one {installed.md5}"
        )
    return installed


def raw_class(known: KnownMessage) -> type:
    """Return a message class of that name and md5 sum whose instances hold bytes."""

    def init(self: Raw, raw: bytes = b"") -> None:
        self._buff = raw

    def deserialize(self: Raw, raw: bytes) -> Raw:
        self._buff = raw
        return self

    def serialize(self: Raw, out: _Sink) -> None:
        out.write(self._buff)

    fields = {
        "__slots__": ["_buff"],
        "__init__": init,
        "_slot_types": [],
        "_type": known.name,
        "_md5sum": known.md5,
        "_full_text": known.text,
        "_has_header": False,  # otherwise rospy would write a sequence number into it
        "serialize": serialize,
        "deserialize": deserialize,
    }
    return type(known.name.replace("/", "_"), (genpy.Message,), fields)


def raw_service(known: KnownService) -> RawService:
    """Return a service class whose requests and responses hold bytes."""
    fields = {
        "_type": known.name,
        "_md5sum": known.md5,
        "_request_class": raw_class(KnownMessage(known.request.name, known.md5, known.request.text)),
        "_response_class": raw_class(KnownMessage(known.response.name, known.md5, known.response.text)),
    }
    return cast(RawService, type(known.name.replace("/", "_"), (), fields))


class RawService(Protocol):
    """A service class whose requests and responses hold bytes."""

    _request_class: Callable[[bytes], Raw]
    _response_class: Callable[[bytes], Raw]


class _Sink(Protocol):
    def write(self, data: bytes) -> int: ...


def _md5(*texts: tuple[str, str]) -> str:
    """Return the md5 sum of one message, or of a service's two, from (name, full text)."""
    context = genmsg.MsgContext.create_default()
    load = genmsg.msg_loader.load_msg_from_string
    try:
        specs = []
        for name, text in texts:
            main, *used = _WITH_FOLDER.sub(r"\1/\2", text.replace("\r\n", "\n")).split(_RULE)
            for section in used:
                head, _, body = section.partition("\n")
                load(context, body, head.removeprefix("MSG:").strip())
            specs.append(load(context, main, name))
        if len(specs) == 1:
            return str(genmsg.compute_md5(context, specs[0]))
        return str(genmsg.compute_md5(context, genmsg.SrvSpec(*specs, "", "", "")))
    except (genmsg.InvalidMsgSpec, genmsg.MsgGenerationException, KeyError, ValueError) as error:
        raise LocalError(f"{texts[0][0]}: the definition cannot be read as a ROS 1 type: {error}") from error
