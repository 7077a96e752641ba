"""Decoders of data from remote proxies: envelopes of ROS messages, descriptions, definitions, messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from gdp.errors import LocalError, RemoteError
from gdp.service.frames import Answer, Outcome, Request, Stop
from proxy.serial.cbor_bounds import check_bounds
from proxy.serial.channel import Channel, Qos, RosVersion, Service
from proxy.serial.converter import MessageConverter, translated_channel
from proxy.serial.schema import DefinitionError, parse
from proxy.serial.serializer import Encoding, Serializer
from proxy.wire.message import RosMessage, TopicDescription
from proxy.wire.service import Exchange, News
from tests.fuzzing.bodies import decoders
from tests.fuzzing.decoder import Decoder

__all__ = ["DECODERS"]

_RULE: Final = "=" * 80 + "\n"
_QOS: Final = Qos(depth=5, reliability="reliable", durability="volatile")
_MSG: Final = f"""\
# a comment
bool flag
uint8[] data
float64[3] three
string<=5 name
string[<=2] names
Inner[] inners
Inner[2] twice
int32 A=-5
string B="text"
float32 c 1.5
{_RULE}MSG: a/Inner
uint8 a
time b
wstring c
Nothing[] d
{_RULE}MSG: a/Nothing
"""
_IDL: Final = f"""{_RULE}IDL: a/msg/B
module a {{ module msg {{
  typedef double double__3[3];
  module B_Constants {{ const long A = -5; const string S = "a" "b"; }};
  @verbatim (language="comment", text="x")
  struct B {{ sequence<octet, 4> data; string<5> name; boolean flag; double__3 d; long a[2]; C c; }};
  struct C {{ wstring w; unsigned long long u; }};
}}; }};
"""
_MSG_TOKENS: Final = (
    *(b"\n", b"\n#", b" ", b"\t", b"[]", b"[<=3]", b"[4000000000]", b"<=5", b"=", b"=1", b"/", b"_", b"@a "),
    *(b"string ", b"wstring ", b"bool a\n", b"int8 ", b"time ", b"Header ", b"Inner[] ", b'"', b"'", b"\\", b"\r\n"),
    _RULE.encode() + b"MSG: a/X\n",
)
_IDL_TOKENS: Final = (
    *(b"module a {", b"struct B {", b"}", b";", b"sequence<", b">", b"(", b"((", b"[", b"]", b"const long A = 1;"),
    *(b"typedef ", b"enum E {", b"::", b"@", b"//", b"/*", b"*/", b'"', b"long ", b"unsigned ", b"string<", b","),
)
_SERIES: Final = (b"\x01\x00\x00\x00", b"\xff\xff\xff\xff", b"\x00\x00\x01\x00", bytes(8))


def _channel(ros: RosVersion) -> Channel:
    text = _MSG.replace("time b", "builtin_interfaces/Time b") if ros == 2 else _MSG.replace("wstring c", "string c")
    return Channel("/t", "a/msg/B", ros, definition=text, definition_format="msg", qos=(_QOS,) * (ros == 2))


def _definition(form: str, ros: int) -> Callable[[bytes], object]:
    return lambda data: parse("a/msg/B", data.decode("utf-8", "replace"), form, ros)


def _raw(ros: RosVersion) -> bytes:
    """Return a message of some content."""
    head = b"" if ros == 1 else b"\x00\x01\x00\x00"
    serializer = Serializer(_channel(ros), "json")
    for size in range(400):
        raw = head + bytes(size)
        if b"$raw" not in serializer.encode(raw):
            return raw
    raise LocalError("no message fits the definition")


def _written(ros: RosVersion, encoding: Encoding) -> Decoder:
    serializer = Serializer(_channel(ros), encoding)
    seeds = (serializer.encode(_raw(ros)),)
    return Decoder(f"{encoding}-{ros}", serializer.decode, seeds, (RemoteError,), is_cbor=encoding == "cbor")


def _read(ros: RosVersion) -> Decoder:
    serializers = [Serializer(_channel(ros), encoding) for encoding in ("json", "cbor")]

    def encode(data: bytes) -> object:
        return [serializer.decode(serializer.encode(data)) for serializer in serializers]

    return Decoder(f"{'ros1' if ros == 1 else 'cdr'}", encode, (_raw(ros),), (), _SERIES)


def _converted() -> Decoder:
    source = _channel(1)
    converter = MessageConverter(source, translated_channel(source, 2))
    return Decoder("twin", converter.convert, (_raw(1),), (RemoteError,), _SERIES)


_HALF: Final = Channel("/s", "a/srv/S_Request", 2, definition="bool a\n", definition_format="msg")
_SERVICE: Final = Service("/s", "a/srv/S", "", _HALF, _HALF)

_MADE: Final = (
    *(_channel(1), _channel(2), _SERVICE),
    *(TopicDescription("json", (_channel(2),)), Exchange("cbor", (_SERVICE,), (_HALF,))),
)

DECODERS: Final = (
    Decoder("parcel", RosMessage.from_wire, (RosMessage(0, 1, b"x").to_wire(),), (RemoteError,)),
    *decoders("proxy", _MADE),
    Decoder("call-request", Request.from_wire, (Request(0, 1, 2, b"x").to_wire(),), (RemoteError,)),
    Decoder("call-answer", Answer.from_wire, (Answer(0, 1, Outcome.ANSWERED, b"x").to_wire(),), (RemoteError,)),
    Decoder("call-stop", Stop.from_wire, (Stop(0, (1, 2)).to_wire(),), (RemoteError,)),
    Decoder("news", News.from_wire, (News(0, 1, b"x").to_wire(),), (RemoteError,)),
    Decoder(
        "cbor-bounds", lambda data: check_bounds(data, 1_000), (_channel(1).to_wire(),), (ValueError,), is_cbor=True
    ),
    Decoder("msg", _definition("msg", 1), (_MSG.encode(),), (DefinitionError,), _MSG_TOKENS),
    Decoder("idl", _definition("idl", 2), (_IDL.encode(),), (DefinitionError,), _IDL_TOKENS),
    _read(1),
    _read(2),
    _written(1, "json"),
    _written(2, "json"),
    _written(1, "cbor"),
    _written(2, "cbor"),
    _converted(),
)
