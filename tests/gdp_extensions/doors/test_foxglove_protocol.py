"""Foxglove messages: those of the server fit the types of the official Python package; any bytes of a client parse."""

from __future__ import annotations

import contextlib
import json
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import RemoteError
from gdp_extensions.doors.core import foxglove_protocol as protocol
from proxy.serial.standard_types import known_channel
from tests.proxy.bridge import known

CHANNEL = known_channel("/chat", known.STRING)
SERVICE = known.services()[known.SET_BOOL]
SERVER_TEXTS = [
    protocol.server_info("gdp", "1"),
    protocol.status(protocol.WARNING, "slow", "slow"),
    protocol.advertise([(1, CHANNEL)]),
    protocol.unadvertise([1]),
    protocol.advertise_services([(2, SERVICE)]),
    protocol.unadvertise_services([2]),
]


@pytest.mark.parametrize("text", SERVER_TEXTS)
def test_a_message_of_the_server_fits_the_official_types(text: str) -> None:
    types = pytest.importorskip("foxglove_websocket.types")
    fields = json.loads(text)
    kinds = {
        "serverInfo": types.ServerInfo,
        "status": types.StatusMessage,
        "advertise": types.Advertise,
        "unadvertise": types.Unadvertise,
        "advertiseServices": types.AdvertiseServices,
        "unadvertiseServices": types.UnadvertiseServices,
    }
    kind = kinds[fields["op"]]
    assert fields.keys() == kind.__annotations__.keys()
    for each in fields.get("channels", []):
        assert each.keys() == {"id", *types.ChannelWithoutId.__annotations__}
    for each in fields.get("services", []):
        assert each.keys() == {"id", *types.ServiceWithoutId.__annotations__}
        assert each["request"].keys() == types.ServiceRequestDefinition.__annotations__.keys()


def test_a_channel_has_the_whole_definition() -> None:
    (channel,) = json.loads(protocol.advertise([(1, known_channel("/image", known.IMAGE))]))["channels"]
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
    assert "MSG: std_msgs/Header" in channel["schema"]


def test_binary_messages_of_the_server_have_the_published_layout() -> None:
    assert protocol.message_data(7, 9, b"cdr") == struct.pack("<BIQ", 1, 7, 9) + b"cdr"
    assert protocol.service_response(2, 3, b"cdr") == struct.pack("<BIII", 3, 2, 3, 3) + b"cdr" + b"cdr"


@pytest.mark.parametrize(
    ("data", "wanted"),
    [
        (
            '{"op":"subscribe","subscriptions":[{"id":1,"channelId":2}]}',
            protocol.SubscribeChannels((protocol.Subscription(1, 2),)),
        ),
        ('{"op":"unsubscribe","subscriptionIds":[1,2]}', protocol.UnsubscribeChannels((1, 2))),
        (
            '{"op":"advertise","channels":[{"id":1,"topic":"/a","encoding":"cdr","schemaName":"a/msg/B"}]}',
            protocol.AdvertiseChannels((protocol.ClientChannel(1, "/a", "cdr", "a/msg/B", "", ""),)),
        ),
        ('{"op":"unadvertise","channelIds":[3]}', protocol.UnadvertiseChannels((3,))),
        (struct.pack("<BI", 1, 5) + b"raw", protocol.PublishMessage(5, b"raw")),
        (struct.pack("<BIII", 2, 5, 6, 3) + b"cdrraw", protocol.CallService(5, 6, "cdr", b"raw")),
    ],
)
def test_a_message_of_a_client_is_parsed(data: str | bytes, wanted: protocol.ClientMessage) -> None:
    assert protocol.parse(data) == wanted


@pytest.mark.parametrize(
    "data",
    [
        "{",
        "[]",
        '{"op":"fetchAsset"}',
        '{"op":"subscribe"}',
        '{"op":"subscribe","subscriptions":[1]}',
        '{"op":"subscribe","subscriptions":[{"id":-1,"channelId":2}]}',
        '{"op":"subscribe","subscriptions":[{"id":true,"channelId":2}]}',
        '{"op":"unsubscribe","subscriptionIds":[4294967296]}',
        '{"op":"advertise","channels":[{"id":1,"topic":"/a","encoding":"cdr"}]}',
        b"",
        b"\1\0\0",
        struct.pack("<BIII", 2, 5, 6, 99) + b"cdr",
        b"\7\0\0\0\0",
    ],
)
def test_another_message_is_refused(data: str | bytes) -> None:
    with pytest.raises(RemoteError):
        protocol.parse(data)


@given(st.one_of(st.binary(max_size=64), st.text(max_size=64)))
def test_arbitrary_data_parse_or_raise_the_remote_error(data: str | bytes) -> None:
    with contextlib.suppress(RemoteError):
        protocol.parse(data)
