"""Unicast streams of one node: their number, which ones are forgotten, and where their numbers continue."""

from __future__ import annotations

import pytest

from gdp.client.send_options import PublisherSettings, SendOptions
from gdp.client.sequence_numbers import SequenceRegistry, SequenceState
from gdp.client.unicast_stream import Party, PeerIncarnation, private_incarnation, private_name
from gdp.client.unicast_streams import STREAMS_MAX, UnicastStreams
from gdp.errors import LocalError
from gdp.intervals import FORGET_S, READER
from gdp.names import Name
from tests.gdp.client.incarnation_ids import note_keys, source_of
from tests.gdp.client.pipe import SECRETS, WRITER

SERVICE = Name(b"s" * 32)
SERVER = source_of(Name(b"p" * 32), 5, WRITER)
CLIENT = PeerIncarnation(Name(b"c" * 32), 7)
EXCHANGE = note_keys().public


def streams_of(sequence_registry: SequenceRegistry | None = None) -> UnicastStreams:
    return UnicastStreams(
        service=SERVICE,
        writer=SERVER,
        secrets=SECRETS,
        sequence_registry=SequenceRegistry() if sequence_registry is None else sequence_registry,
        published=lambda _: None,
    )


def client(number: int) -> Party:
    return Party(PeerIncarnation(Name(number.to_bytes(32, "big")), number), EXCHANGE)


def test_the_stream_to_each_reader_has_the_options_of_its_service() -> None:
    options = SendOptions(weight=5, max_bits_s=2e6)
    streams = UnicastStreams(
        service=SERVICE,
        writer=SERVER,
        secrets=SECRETS,
        sequence_registry=SequenceRegistry(),
        published=lambda _: None,
        settings=PublisherSettings(options=options),
    )
    assert streams.stream(client(1), 1500, 0.0).options == options


def test_every_end_and_every_life_has_a_stream_of_its_own() -> None:
    server = PeerIncarnation(SERVER.name, SERVER.incarnation)
    names = {
        private_name(service, one, other)
        for service in (SERVICE, Name(b"t" * 32))
        for one in (server, server._replace(incarnation=6))
        for other in (CLIENT, CLIENT._replace(incarnation=8), PeerIncarnation(Name(b"d" * 32), 7))
    }
    assert len(names) == len({private_incarnation(name) for name in names}) == 12


def test_the_name_of_a_private_stream_is_this() -> None:
    name = private_name(SERVICE, PeerIncarnation(SERVER.name, SERVER.incarnation), CLIENT)
    assert name.to_text() == "a1d677801a4a75f965a64c1de83026087bc56cc0a2287107cbdbae66d3d8b19a"
    assert f"{private_incarnation(name):016x}" == "98ab1e4af377bf56"


def test_a_session_stream_has_a_name_of_its_own() -> None:
    ends = SERVICE, PeerIncarnation(SERVER.name, SERVER.incarnation), CLIENT
    assert private_name(*ends, is_session=True) != private_name(*ends)


def test_there_are_no_more_streams_than_the_bound_while_all_are_in_use() -> None:
    desk = streams_of()
    for number in range(STREAMS_MAX):
        desk.stream(client(number), 1500, 0.0)
    with pytest.raises(LocalError, match="no more at once"):
        desk.stream(client(STREAMS_MAX), 1500, 0.0)
    assert len(desk) == STREAMS_MAX


def test_a_silent_client_gives_way_to_one_that_asks() -> None:
    desk = streams_of()
    for number in range(STREAMS_MAX):
        desk.stream(client(number), 1500, 0.0)
    for stream in desk:
        stream.handle_timer(READER.lease_s + 1)
    desk.stream(client(STREAMS_MAX), 1500, READER.lease_s + 1)
    assert len(desk) == STREAMS_MAX


def test_an_idle_stream_is_forgotten_and_its_numbers_are_not() -> None:
    sequence_registry = SequenceRegistry()
    desk = streams_of(sequence_registry)
    desk.stream(Party(CLIENT, EXCHANGE), 1500, 0.0).publish(bytes(60_000))
    desk.forget_idle(FORGET_S)
    assert len(desk) == 1
    for stream in desk:
        stream.handle_timer(READER.lease_s + 1)
    desk.forget_idle(2 * FORGET_S)
    assert (len(desk), len(sequence_registry)) == (0, 1)
    assert desk.stream(Party(CLIENT, EXCHANGE), 1500, 200.0).past == SequenceState(2, 0, 1)


def test_a_former_life_of_a_client_does_not_close_the_stream_to_its_present_one() -> None:
    desk = streams_of()
    stream = desk.stream(Party(CLIENT, EXCHANGE), 1500, 0.0)
    desk.forget(CLIENT._replace(incarnation=6))
    assert desk.stream(Party(CLIENT, EXCHANGE), 1500, 0.0) is stream


def test_the_sequence_registry_is_bounded_and_a_forgotten_name_raises_the_lowest_number() -> None:
    sequence_registry = SequenceRegistry(2)
    for number in range(3):
        sequence_registry.put(Name(bytes([number]) * 32), SequenceState(10 + number, number))
    assert len(sequence_registry) == 2
    assert sequence_registry.of(Name(b"\x00" * 32)) == SequenceState(10, 0)
    assert sequence_registry.of(Name(b"\x02" * 32)) == SequenceState(12, 2)
    assert sequence_registry.of(Name(b"x" * 32)) == SequenceState(10, 0)
