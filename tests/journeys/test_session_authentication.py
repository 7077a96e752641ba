"""Unicast streams under a session secret: without signatures where both ends ask for it, and never otherwise."""

from __future__ import annotations

from dataclasses import dataclass
from os import urandom

import pytest

from gdp.client.participant import Participant, Topic
from gdp.client.unicast_stream import PeerIncarnation, private_incarnation, private_name
from gdp.crypto.envelope import SEAL_BYTES, SIGNATURE_BYTES, KeyContext, Sealer
from gdp.crypto.exchange import ExchangeKey
from gdp.crypto.keys import SigningKey
from gdp.crypto.session_seal import session_secret
from gdp.errors import DropReason
from gdp.frame.codec import FLAGS_AT, Flag, Kind
from gdp.limits import SEQUENCE_BYTES
from gdp.names import Name
from gdp.sansio import ReceivedFrame
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.right import Right
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, SERVER, Tap, row
from tests.journeys.services import Party, meet, outlive, work

ANSWER = b"? by nuc5/server"
UNSIGNED = SEAL_BYTES + SEQUENCE_BYTES + len(ANSWER)


@dataclass
class Pair:
    """A server and a client, and the frames that reach the client."""

    world: Simulation
    server: Party
    client: Party
    tap: Tap

    def ask(self) -> set[int]:
        """Let the client ask once; return the payload lengths of the answer's frames."""
        seen, have = len(self.tap.headers), len(self.client.collect())
        self.client.publish(b"?")
        assert work(self.world, self.server, self.client, until_s=3, have=have + 1)
        assert self.client.got[-1].delivered.message == ANSWER
        private = [each for each in self.tap.headers[seen:] if each.destination == self.client.member.name]
        return {each.length for each in private if each.kind == Kind.DATA}

    def inject(self, frames: list[bytes]) -> None:
        """Let frames arrive at the client, as if its switch had forwarded them."""
        neighbour = self.client.member.attachment.switch
        assert neighbour is not None
        arrivals = [ReceivedFrame(neighbour.port, neighbour.mac, frame) for frame in frames]
        self.client.member.receive(arrivals, self.world.network.now)

    def forge(self, secret: bytes, *, is_session: bool, signer: SigningKey | None) -> list[bytes]:
        """Return the frames of a message to the client in the server's name, which any member could send."""
        (at_client,) = self.client.member.subscriptions.writer_proxies_of(self.client.service)
        (at_server,) = self.server.member.subscriptions.writer_proxies_of(self.server.service)
        server = PeerIncarnation(self.server.member.name, at_client.incarnation)
        client = PeerIncarnation(self.client.member.name, at_server.incarnation)
        stream = private_name(self.client.service, server, client, is_session=is_session)
        sealer = Sealer(
            secret=secret,
            epoch=1,
            context=KeyContext(Kind.DATA, server.name, private_incarnation(stream), stream),
            address=client.name,
            signer=signer,
            random_bytes=urandom,
        )
        return list(sealer.seal(50, Flag.RELIABLE, bytes(7) + b"\x32" + b"forged" * 20, 1500))


def pair_of(server: bool = True, client: bool = True, world: Simulation | None = None) -> Pair:
    """Return a server and a client that know each other; each asks for a session secret or does not."""
    world = row() if world is None else world
    parties = (
        Party(world, SERVER, Right.SERVE, is_session=server),
        Party(world, ROBOT, Right.CALL, is_session=client),
    )
    assert meet(world, *parties)
    tap = Tap("nuc1", ROBOT)
    world.network.taps.append(tap)
    return Pair(world, *parties, tap)


def topic_secret(pair: Pair) -> bytes:
    """Return what every member of the service has."""
    return topic_of(pair.world, pair.client.member, Right.CALL, [1]).secrets[1]


def topic_of(world: Simulation, member: Participant, right: Right, epochs: list[int]) -> Topic:
    """Return the service for a member, with the secrets of these epochs."""
    identity = next(each for each in world.identities.values() if each.name == member.name)
    described = world.topic("/add_two_ints", member, [right], kind="service").delegation.metadata
    assert described is not None
    card = NodeDescriptor.from_wire(NodeDescriptor.make(identity))
    given = world.owner.delegate(card, described, [right], epochs, world.validity)
    return Topic(given, {epoch: grant.secret for epoch, grant in given.open(identity).items()})


def incarnations(pair: Pair) -> set[int]:
    """Return the incarnations of each end that the other knows."""
    parties = (pair.server, pair.client)
    return {
        each.incarnation for party in parties for each in party.member.subscriptions.writer_proxies_of(party.service)
    }


def drops(pair: Pair, reason: DropReason) -> int:
    """Return how many frames the client dropped for a reason."""
    return pair.client.member.drops().get(reason, 0)


def test_answers_are_not_signed_where_both_ends_ask_for_a_session_secret() -> None:
    pair = pair_of()
    assert pair.ask() == {UNSIGNED}
    outlive(pair.world, pair.client, pair.server)


@pytest.mark.parametrize(("server", "client"), [(True, False), (False, True), (False, False)])
def test_answers_are_signed_unless_both_ends_ask_for_a_session_secret(server: bool, client: bool) -> None:
    pair = pair_of(server, client)
    assert pair.ask() == {UNSIGNED + SIGNATURE_BYTES}
    outlive(pair.world, pair.client, pair.server)


@pytest.mark.momentary("one message is compared with what was sent; no state is to last")
def test_a_large_answer_of_many_fragments_is_repaired_without_a_signature() -> None:
    pair = pair_of()
    pair.server.answers = False
    pair.world.leads[ROBOT].loss = 0.1
    large = urandom(100_000)
    for _ in range(10):
        pair.server.answer(pair.client.member.name, large)
    assert work(pair.world, pair.client, until_s=20, have=10)
    assert pair.client.bodies() == [large] * 10


@pytest.mark.momentary("a forged frame is refused at once")
def test_a_member_with_the_topic_secret_cannot_make_a_message_of_a_session_stream() -> None:
    pair = pair_of()
    pair.ask()
    before = drops(pair, DropReason.BAD_TAG)
    (at_client,) = pair.client.member.subscriptions.writer_proxies_of(pair.client.service)
    own_agreement = ExchangeKey.from_random(urandom(32)).agree(at_client.exchange, b"gdp-note-shared-1")[0]
    guesses = [topic_secret(pair), session_secret(own_agreement, topic_secret(pair), pair.client.service)]
    for secret in guesses:
        for signer in (None, SigningKey.generate()):
            pair.inject(pair.forge(secret, is_session=True, signer=signer))
    assert pair.client.member.poll_messages() == []
    assert drops(pair, DropReason.BAD_TAG) == before + 4


@pytest.mark.momentary("a forged frame is refused at once")
@pytest.mark.parametrize(("server", "client"), [(True, False), (False, True), (False, False)])
def test_an_unsigned_message_is_refused_unless_both_ends_ask_for_a_session_secret(server: bool, client: bool) -> None:
    pair = pair_of(server, client)
    pair.ask()
    for is_session in (False, True):
        pair.inject(pair.forge(topic_secret(pair), is_session=is_session, signer=None))
    assert pair.client.member.poll_messages() == []
    assert drops(pair, DropReason.NOT_FOR_US) >= 1  # of the session stream, for which there is no state
    assert drops(pair, DropReason.BAD_TAG) >= 1  # of the signed stream: the signature's bytes are missing


@pytest.mark.momentary("a forged frame is refused at once")
def test_a_message_under_the_topic_secret_is_refused_where_a_session_secret_is_agreed() -> None:
    pair = pair_of()
    pair.ask()
    before = drops(pair, DropReason.NOT_FOR_US)
    pair.inject(pair.forge(topic_secret(pair), is_session=False, signer=SigningKey.generate()))
    assert pair.client.member.poll_messages() == []
    assert drops(pair, DropReason.NOT_FOR_US) == before + 1


@pytest.mark.momentary("a recorded frame is refused at once")
def test_a_recorded_message_of_a_session_stream_is_delivered_once() -> None:
    pair = pair_of()
    pair.ask()
    recorded = [
        frame for header, frame in zip(pair.tap.headers, pair.tap.frames, strict=True) if header.kind == Kind.DATA
    ]
    before = drops(pair, DropReason.LATE)
    pair.inject(recorded)
    assert pair.client.member.poll_messages() == []
    assert drops(pair, DropReason.LATE) > before


@pytest.mark.momentary("an altered frame is refused at once")
def test_a_flag_of_a_session_stream_cannot_be_altered() -> None:
    pair = pair_of()
    pair.server.answers = False
    pair.world.leads[ROBOT].loss = 1.0
    pair.server.answer(pair.client.member.name, b"held")
    pair.world.network.run(0.02)
    tap = pair.tap.frames
    sent = next(frame for frame in reversed(tap) if len(frame) < 200 and frame[1] == Kind.DATA)
    altered = bytearray(sent)
    altered[FLAGS_AT] ^= int(Flag.BUNDLE)
    pair.inject([bytes(altered)])
    assert pair.client.member.poll_messages() == []
    assert drops(pair, DropReason.BAD_TAG) == 1


@pytest.mark.parametrize("label", [SERVER, ROBOT])
def test_a_restarted_end_gets_a_new_session_secret_and_old_frames_do_not_open(label: str) -> None:
    pair = pair_of()
    pair.ask()
    recorded, former = pair.tap.frames[:], incarnations(pair)
    pair.world.restart_member(label)
    party = pair.server if label == SERVER else pair.client
    party.got.clear()
    party.begin()
    assert pair.world.network.run(20, lambda: bool(incarnations(pair) - former))
    assert meet(pair.world, pair.server, pair.client, within_s=20)
    assert pair.ask() == {UNSIGNED}
    pair.inject([frame for frame in recorded if frame[1] == Kind.DATA])
    assert pair.client.member.poll_messages() == []
    outlive(pair.world, pair.client, pair.server)


def test_a_new_epoch_costs_no_answer_of_a_session_stream() -> None:
    pair = pair_of()
    pair.ask()
    pair.client.member.renew(topic_of(pair.world, pair.client.member, Right.CALL, [1, 2]))
    pair.server.member.renew(topic_of(pair.world, pair.server.member, Right.SERVE, [1, 2]))
    assert pair.ask() == {UNSIGNED}
    assert {each.epoch for each in pair.tap.headers if each.kind == Kind.DATA} == {1, 2}
    outlive(pair.world, pair.client, pair.server)


@pytest.mark.parametrize("is_withdrawal_lost", [False, True])
def test_an_end_that_no_longer_asks_for_a_session_secret_gets_signed_answers(is_withdrawal_lost: bool) -> None:
    pair = pair_of()
    pair.ask()
    pair.world.leads[ROBOT].loss = float(is_withdrawal_lost)
    pair.client.member.withdraw(pair.client.service)
    pair.world.network.send_pending(ROBOT)
    pair.world.leads[ROBOT].loss = 0.0
    pair.client.is_session = False
    pair.client.begin()
    assert meet(pair.world, pair.server, pair.client)
    assert pair.ask() == {UNSIGNED + SIGNATURE_BYTES}
    outlive(pair.world, pair.client, pair.server)


def test_a_session_secret_depends_on_agreement_epoch_and_stream() -> None:
    one, other, stream = b"1" * 32, b"2" * 32, Name(b"s" * 32)
    secrets = {session_secret(*each) for each in ((one, one, stream), (other, one, stream), (one, other, stream))}
    assert len(secrets | {session_secret(one, one, Name(b"t" * 32))}) == 4
