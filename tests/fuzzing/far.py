"""Descriptions with a message of any step, through the bridge: imported topics, and both sides of a service.

An input is one map in CBOR: ``d`` a description whose channels are maps, ``b`` a body, ``s`` the steps that its message
states, ``z`` whether the body is compressed here before it is sent.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from io import BytesIO
from types import SimpleNamespace
from typing import Any, Final, cast

import cbor2
import orjson

from gdp.client.delivery import Delivered
from gdp.client.participant import Message, Participant, Topic
from gdp.control.boundary import ErrorBoundary
from gdp.errors import DropReason, GdpError, LocalError, RemoteError
from gdp.message.loss import Losses
from gdp.names import Name
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.action_interface import ActionInterface
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.core.remote_server import RemoteServer
from proxy.bridge.counters import Traffic
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.faults import Fault, Faults
from proxy.bridge.imported_topic import ImportedTopic
from proxy.bridge.remote_clients import RemoteClients
from proxy.config.rule import Rule
from proxy.endpoints.core.endpoint import Origin, RosEndpoint
from proxy.recordings.mcap_writer import McapWriter
from proxy.serial.channel import Channel, Qos
from proxy.serial.empty import NoAnswer
from proxy.serial.rosbridge_json import RosbridgeCodec, cbor_raw
from proxy.serial.serializer import Encoding
from proxy.tools.message_text import MessageText
from proxy.wire.message import RosMessage, Step
from tests.fuzzing.decoder import Decoder

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

__all__ = ["DECODERS"]

_NAME: Final = Name(b"t" * 32)
_RULE: Final = Rule.model_construct(name="/t", max_bytes=1 << 20)
_LINE: Final = "=" * 80 + "\n"
_INNER: Final = f"{_LINE}MSG: a/I\nint8[0] a\n{_LINE}MSG: a/Nothing\n"
_DEFINITIONS: Final = (
    "bool[0] a\nint8 b\n",
    "I a\nI[0] b\nI[<=0] c\nstring[0] d\nfloat64 e\n",
    "Nothing a\nNothing[0] b\nNothing[] c\nwstring d\n",
    "",
)
_IMAGE: Final = "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
_BROKEN: Final = bytes.fromhex("37a430ec") + b"\xff" * 200
_QOS: Final = Qos(depth=5, reliability="reliable", durability="volatile")
_TOKENS: Final = (
    b"[0] ",
    b"[<=0] ",
    b"[2] ",
    b"a\n",
    b"bool",
    b"int8 b\n",
    b"I ",
    b"Nothing",
    b"zstd",
    b"png",
    b"jpeg",
)


class _Reraising(ErrorBoundary):
    """Boundary that lets errors through in every program that fuzzes."""

    reraises = True


class _Quiet(Faults):
    """Faults that are not logged."""

    def report(self, what: str, fault: Fault, detail: str) -> None:
        """Do nothing: thousands of lines would follow."""


class _Endpoint:
    """Graph without a type of its own; it reads each message as a door, a tool and a recorder do."""

    ros: Final = 2

    def __init__(self, *, is_live: bool) -> None:
        self.is_live = is_live
        self._channels: list[Channel] = []
        self._recorder = McapWriter(BytesIO())

    def channel(self, topic: str, type_name: str) -> Channel:
        raise LocalError(f"{topic}: no {type_name} here")

    def service(self, name: str, type_name: str) -> object:
        raise LocalError(f"{name}: no {type_name} here")

    def advertise(self, channel: Channel) -> int:
        self._channels.append(channel)
        self._recorder.connect(channel)
        return len(self._channels) - 1

    def publish(self, handle: int, raw: bytes) -> None:
        channel = self._channels[handle]
        if channel.ros == 2:
            _outcome(lambda: RosbridgeCodec(channel).to_json(raw))
            _outcome(lambda: RosbridgeCodec(channel).to_cbor("/t", raw))
            _outcome(lambda: cbor_raw("/t", 0, raw))
        text = MessageText(channel)
        _outcome(lambda: text.to_yaml(raw).encode())
        orjson.dumps(text.to_json(raw))

    def record(self, handle: int, raw: bytes, origin: Origin) -> None:
        self._recorder.write(handle, 0, raw, origin)
        self._recorder.flush()

    def close(self, handle: int) -> None:
        """Keep it."""


def _fields(data: bytes) -> tuple[dict[Any, Any], bytes, Step]:
    """Return the description, the body and its steps of an input."""
    try:
        match cbor2.loads(data):
            case {"d": {**described}, "b": bytes(body), "s": int(steps), "z": packs}:
                if packs is True:
                    body = zstd.compress(body)
                return described, body, Step(steps & 255)
    except (ArithmeticError, LookupError, RecursionError, TypeError, ValueError, cbor2.CBORError) as error:
        raise RemoteError(DropReason.MALFORMED, "no input") from error
    raise RemoteError(DropReason.MALFORMED, "no input")


def _packed(value: object, *keys: str) -> object:
    """Return a map, or each of a list, with what these keys hold as bytes, and as bytes itself."""
    try:
        if isinstance(value, list):
            return [_packed(each, *keys) for each in value]
        if not isinstance(value, dict):
            return value
        return cbor2.dumps({key: _packed(each) if key in keys else each for key, each in value.items()}, canonical=True)
    except (ArithmeticError, LookupError, RecursionError, TypeError, ValueError, cbor2.CBORError) as error:
        raise RemoteError(DropReason.MALFORMED, "no input") from error


def _receive(data: bytes) -> object:
    described, body, steps = _fields(data)
    description = _packed({**described, "c": _packed(described.get("c"))})
    assert isinstance(description, bytes)
    wire = RosMessage(0, 1, body, steps).to_wire()
    for is_live in (True, False):
        member = SimpleNamespace(losses_of=lambda _: Losses(), diagnostics=SimpleNamespace(clock_of=lambda *_: None))
        context = BridgeContext(cast(Participant, member), Traffic(), _Quiet(), boundary=_Reraising())
        dispatcher = EndpointDispatcher(cast(RosEndpoint, _Endpoint(is_live=is_live)))
        flow_spec = FlowSpec(False, "/t", _type_of(described), _NAME, _RULE)
        flow = ImportedTopic(context, dispatcher, flow_spec, cast(Topic, SimpleNamespace(name=_NAME)))
        for number in range(2):
            delivered = Delivered(b"p" * 32, 1, number, wire, 1, 1)
            fields: dict[str, Any] = {"topic": _NAME, "description": description, "delivered": delivered}
            flow.receive(Message(**fields), 0.0)
    return None


def _type_of(described: dict[Any, Any]) -> str:
    match described:
        case {"c": [{"n": str(type_name)}, *_]}:
            return type_name
    return "a/msg/B"


def _serve(data: bytes) -> object:
    described, body, _ = _fields(data)
    parts = {"s": _packed(described.get("s"), "q", "r"), "c": _packed(described.get("c"))}
    description = _packed({**described, **parts})
    assert isinstance(description, bytes)
    interface = ActionInterface.of("service", "/t", "a/srv/S")
    endpoint = cast(RosEndpoint, _Endpoint(is_live=True))
    rule = Rule.model_construct(encoding="json", fields_differ="default")
    server = RemoteServer.set_description(1, description, interface, endpoint, rule)
    assert server.ours is not None
    empty = [NoAnswer.of(each) for each in server.ours.services]
    clients = RemoteClients(server.ours, 2, is_strict=False)
    return (
        [each.to_raw("reason") for each in empty if each is not None],
        _outcome(lambda: clients.incoming(b"p" * 32, description, 0).decode(body)),
        _outcome(lambda: server.answers[0].decode(body)),
    )


def _outcome(decode: Callable[[], bytes]) -> bytes | GdpError:
    try:
        return decode()
    except GdpError as error:
        return error


def _channel(definition: str, type_name: str = "a/msg/B") -> object:
    channel = Channel("/t", type_name, 2, definition=definition + _INNER, definition_format="msg", qos=(_QOS,))
    return cbor2.loads(channel.to_wire())


def _input(described: dict[str, object], steps: int, body: bytes, *, packs: bool = False) -> bytes:
    return cbor2.dumps({"d": described, "s": steps, "b": body, "z": packs})


def _topic(encoding: Encoding, definition: str, **more: object) -> dict[str, object]:
    return {"e": encoding, "c": [_channel(definition)], **more}


_IMAGED: Final[dict[str, object]] = {
    "e": "cdr",
    "c": [_channel(_IMAGE, "sensor_msgs/msg/Image")],
    "z": "zstd",
    "i": "png",
}
_BODIES: Final[tuple[tuple[Encoding, bytes], ...]] = (
    ("json", b'{"a":[],"b":0}'),
    ("cbor", cbor2.dumps({"a": [], "b": 0})),
    ("cdr", b"\0\1\0\0" + bytes(8)),
)
_TOPICS: Final = (
    *(_input(_topic(encoding, each), 0, body) for each in _DEFINITIONS for encoding, body in _BODIES),
    _input(_topic("json", _DEFINITIONS[0], z="zstd"), int(Step.ZSTD), b'{"a":[],"b":0}' + b" " * 40, packs=True),
    _input(_topic("cdr", _DEFINITIONS[0], z="zstd", d=_BROKEN), int(Step.ZSTD), bytes(40)),
    _input(_IMAGED, int(Step.ZSTD | Step.IMAGE), b"\0\1\0\0" + bytes(60), packs=True),
    _input(_IMAGED, int(Step.IMAGE), b"\0\1\0\0" + bytes(40)),
)


def _service(encoding: Encoding, request: str, response: str) -> dict[str, object]:
    halves = {"q": _channel(request, "a/srv/S_Request"), "r": _channel(response, "a/srv/S_Response")}
    return {"e": encoding, "s": [{"n": "/t", "t": "a/srv/S", "h": "", **halves}], "c": []}


_SERVICES: Final = tuple(
    _input(_service(encoding, _DEFINITIONS[at], _DEFINITIONS[at - 1]), 0, body)
    for at in range(len(_DEFINITIONS))
    for encoding, body in _BODIES
)

DECODERS: Final = (
    Decoder("far-topic", _receive, _TOPICS, (GdpError,), _TOKENS, is_cbor=True, time_max_ms=250.0),
    Decoder("far-service", _serve, _SERVICES, (GdpError,), _TOKENS, is_cbor=True, time_max_ms=250.0),
)
