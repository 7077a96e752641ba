"""Secure channels between a switch and a RIB, or two RIBs: records are fresh and of proven origin.

Sans-I/O; time comes in as ``Timestamps``. Source: the handshake follows SIGMA (signed ephemeral X25519 keys, in the
manner of RFC 7296); the records follow RFC 9147. A signed statement alone proves its signer, not its time. An attacker
could replay a recorded one after any restart. Therefore a record belongs to one channel, and a channel to one
incarnation of both ends::

    client --OPEN (its key, for which RIB)---------------> RIB     padded: the reply is never longer
    client <--ACCEPT (of that OPEN, channel, its key)----- RIB
    client --record(channel, number, [query])------------> RIB     the first one proves that the client is present now
    client <--record(channel, number, [response])--------- RIB
    client <--UNKNOWN (channel)--------------------------- a RIB that was restarted: a hint, which forces nothing

A recorded OPEN costs the RIB one key agreement and one signature, rate-limited for each peer. It displaces no channel
in use.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, Final, NamedTuple

from gdp.crypto.certificates import Role
from gdp.crypto.exchange import EXCHANGE_KEY_BYTES, ExchangeKey
from gdp.crypto.identity import Identity
from gdp.crypto.records import RecordKey
from gdp.crypto.schema import NAME, OCTETS, Body, Keyed, octets
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.errors import DropReason, FrameError, StatementError
from gdp.intervals import HOUR_S, Rate
from gdp.limits import CONTROL_MAX_BYTES, RECORD_OVERHEAD_BYTES
from gdp.message.replay import ReplayWindow
from gdp.names import Name
from gdp.requests import Backoff, Requests
from gdp.sansio import Timestamps
from gdp.token_bucket import TokenBucket
from gdp.trust.domain import Policy

_RECORD: Final = 0x01  # a statement begins with 0xd2
_UNKNOWN: Final = 0x02
_ID_BYTES: Final = 8
_NUMBER_BYTES: Final = 8
_HEAD_BYTES: Final = 1 + _ID_BYTES + _NUMBER_BYTES
_OFFER_BYTES: Final = 1_536  # minimum size of an OPEN: more than any ACCEPT
_PURPOSES: Final = (b"gdp channel, from asker ", b"gdp channel, to asker ")
_WINDOW: Final = 4_096  # records that may come out of order
_OFFERS: Final = Backoff(0.1, 0.8)  # of an OPEN
_OFFER_TRIES: Final = 4  # then the channel waits for news of the peer
_WAITING_MAX: Final = 256  # statements that wait for a channel
_WAITING_S: Final = 1.0  # by then the sender repeats a statement itself
_REOPEN_S: Final = 0.3  # minimum time between two reactions to a hint
_CHANNELS_PER_PEER: Final = 2  # in use: the newest, and the one before
_OFFERS_PER_PEER: Final = 4  # accepted, and not in use yet
_PEERS_MAX: Final = 8_192
_OFFERS_RATE: Final = Rate(20.0, burst=20.0)  # accepted of one peer
_HINTS_RATE: Final = Rate(100.0, burst=100.0)
_PEER_ROLES: Final = (Role.SWITCH, Role.LEAF, Role.RIB)


@dataclass(frozen=True, slots=True)
class _Open(Body):
    """Offer of a channel to a RIB, by the public X25519 key of its sender."""

    TYPE = StatementType.OPEN
    key: Annotated[bytes, Keyed("k", octets(EXCHANGE_KEY_BYTES))]
    rib: Annotated[Name, Keyed("w", NAME)]
    padding: Annotated[bytes, Keyed("p", OCTETS, absent=b"")] = b""


@dataclass(frozen=True, slots=True)
class _Accept(Body):
    """Acceptance of an offer, by its fingerprint."""

    TYPE = StatementType.ACCEPT
    offer: Annotated[bytes, Keyed("o", octets(32))]
    channel: Annotated[bytes, Keyed("i", octets(_ID_BYTES))]
    key: Annotated[bytes, Keyed("k", octets(EXCHANGE_KEY_BYTES))]
    asker: Annotated[Name, Keyed("w", NAME)]


class Opened(NamedTuple):
    """A received statement, and whether it came in a channel with its sender."""

    wire: bytes
    is_fresh: bool


class Outgoing(NamedTuple):
    """A record to send; ``is_answer``: to a peer that opened the channel."""

    to: Name
    wire: bytes
    is_answer: bool = False


@dataclass(slots=True, kw_only=True)
class _Channel:
    id: bytes
    out_key: RecordKey
    in_key: RecordKey
    begun_s: float
    sent: int = 0
    window: ReplayWindow = field(default_factory=lambda: ReplayWindow(_WINDOW))
    accept: bytes = b""  # our reply, to be repeated

    def seal(self, plaintext: bytes) -> bytes:
        head = bytes([_RECORD]) + self.id + self.sent.to_bytes(_NUMBER_BYTES, "big")
        self.sent += 1
        return head + self.out_key.seal(self.sent - 1, head, plaintext)

    def open(self, record: bytes) -> bytes:
        head = record[:_HEAD_BYTES]
        number = int.from_bytes(head[1 + _ID_BYTES :], "big")
        if self.window.is_finished(number):
            raise FrameError(DropReason.REPLAYED, "a record of a channel")
        plaintext = self.in_key.open(number, head, record[_HEAD_BYTES:])
        self.window.finish(number)
        return plaintext


@dataclass(slots=True)
class _Offer:
    """Our OPEN that is under way."""

    key: ExchangeKey
    wire: bytes
    fingerprint: bytes


@dataclass(slots=True)
class _Asked:
    """Our channel to a peer that we query."""

    channel: _Channel | None = None
    offer: _Offer | None = None
    waiting: deque[tuple[bytes, float]] = field(default_factory=lambda: deque(maxlen=_WAITING_MAX))
    reopened_s: float = float("-inf")


@dataclass(slots=True)
class _Asker:
    """The channels that a peer opened to us, by identifier; the newest last."""

    channels: OrderedDict[bytes, _Channel] = field(default_factory=OrderedDict)
    offers: OrderedDict[bytes, _Channel] = field(default_factory=OrderedDict)  # by fingerprint of the OPEN
    pace: TokenBucket = field(default_factory=lambda: TokenBucket(*_OFFERS_RATE))


class Channels:
    """Channels of one node; ``accepts``: whether others may open channels here."""

    def __init__(
        self, identity: Identity, policy: Policy, random_bytes: Callable[[int], bytes], *, accepts: bool
    ) -> None:
        self._identity = identity
        self._policy = policy
        self._random_bytes = random_bytes
        self._accepts = accepts
        self._asked: dict[Name, _Asked] = {}
        self._offers = Requests[Name]()  # ours, by peer
        self._askers: OrderedDict[Name, _Asker] = OrderedDict()
        self._hints = TokenBucket(*_HINTS_RATE)
        self._out: list[Outgoing] = []
        self.drops: Counter[DropReason] = Counter()

    def send_query(self, peer: Name, statement: bytes, now_s: float) -> None:
        """Send a statement to a peer that we query, once there is a channel."""
        asked = self._asked.setdefault(peer, _Asked())
        if asked.channel is None:
            asked.waiting.append((statement, now_s + _WAITING_S))
            self._open(peer, asked, now_s)
            return
        if now_s - asked.channel.begun_s >= HOUR_S:
            self._open(peer, asked, now_s)
        self._out.append(Outgoing(peer, asked.channel.seal(statement)))

    def send_response(self, peer: Name, statement: bytes) -> bool:
        """Send a statement over the channel that a peer opened; return whether there is one."""
        asker = self._askers.get(peer)
        if asker is None or not asker.channels:
            return False
        self._askers.move_to_end(peer)
        self._out.append(Outgoing(peer, next(reversed(asker.channels.values())).seal(statement), is_answer=True))
        return True

    def renew(self, peer: Name) -> None:
        """Open a new channel before anything else is sent: the peer was restarted, and its keys are lost."""
        asked = self._asked.get(peer)
        if asked is not None:
            asked.channel = None
            self._end_offer(peer, asked)

    def forget(self, peer: Name) -> None:
        """Drop all state of a peer."""
        self._asked.pop(peer, None)
        self._offers.cancel(peer)
        self._askers.pop(peer, None)

    def receive(self, wire: bytes, sender: Name, now: Timestamps) -> Opened | None:
        """Process a received record; return the statement in it, unless it concerns the channel only.

        Raises:
            RemoteError: the record or its signature is invalid.
        """
        if wire[:1] == bytes([_RECORD]):
            return Opened(self._take_record(wire, sender, now.mono_s), is_fresh=True)
        if wire[:1] == bytes([_UNKNOWN]):
            self._take_hint(wire[1:], sender, now.mono_s)
            return None
        statement = parse(wire)
        if statement.type not in (StatementType.OPEN, StatementType.ACCEPT):
            return Opened(wire, is_fresh=False)
        if statement.signer != sender:
            raise StatementError(DropReason.UNKNOWN_SENDER, "signed by another than its sender")
        if statement.type is StatementType.OPEN:
            self._take_offer(statement, now)
        else:
            self._take_accept(statement, now)
        return None

    def handle_timer(self, now_s: float) -> None:
        """Repeat what was not accepted yet."""
        for peer in self._offers.poll_due(now_s):
            asked = self._asked[peer]
            if asked.offer is not None and self._offers.tries(peer) < _OFFER_TRIES:
                self._offer(peer, asked.offer, now_s)
                continue
            self._end_offer(peer, asked)
            self.drops[DropReason.NO_CHANNEL] += len(asked.waiting)
            asked.waiting.clear()
            if asked.channel is None:
                del self._asked[peer]

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next repetition, or None."""
        return self._offers.next_due()

    def records_to_send(self) -> list[Outgoing]:
        """Return, once, the records to send."""
        out, self._out = self._out, []
        return out

    # -- the querying side

    def _open(self, peer: Name, asked: _Asked, now_s: float) -> None:
        if asked.offer is not None:
            return
        key = ExchangeKey.from_random(self._random_bytes(EXCHANGE_KEY_BYTES))
        body = _Open(key.public, peer)
        bare = self._identity.signed(body)
        wire = self._identity.signed(replace(body, padding=bytes(max(_OFFER_BYTES - len(bare), 0))))
        asked.offer = _Offer(key, wire, parse(wire).fingerprint)
        asked.reopened_s = now_s
        self._offers.start(peer, now_s)
        self._offer(peer, asked.offer, now_s)

    def _offer(self, peer: Name, offer: _Offer, now_s: float) -> None:
        self._offers.sent(peer, now_s, _OFFERS)
        self._out.append(Outgoing(peer, offer.wire))

    def _end_offer(self, peer: Name, asked: _Asked) -> None:
        asked.offer = None
        self._offers.cancel(peer)

    def _take_accept(self, statement: Statement, now: Timestamps) -> None:
        accept = _Accept.from_statement(statement)
        asked = self._asked.get(statement.signer)
        offer = None if asked is None else asked.offer
        if asked is None or offer is None or accept.offer != offer.fingerprint:
            raise StatementError(DropReason.REPLAYED, "it accepts no offer of ours")
        self._verified(statement, now)
        keys = _keys(offer.key, accept.key, offer.fingerprint, statement.fingerprint)
        asked.channel = _Channel(id=accept.channel, out_key=keys[0], in_key=keys[1], begun_s=now.mono_s)
        self._end_offer(statement.signer, asked)
        waiting, asked.waiting = list(asked.waiting), deque(maxlen=_WAITING_MAX)
        for wire, until_s in waiting:
            if until_s > now.mono_s:
                self._out.append(Outgoing(statement.signer, asked.channel.seal(wire)))

    def _take_hint(self, id_: bytes, sender: Name, now_s: float) -> None:
        """Reopen the channel if the interval allows it; until then statements still use the known channel."""
        asked = self._asked.get(sender)
        if asked is None or asked.channel is None or asked.channel.id != id_:
            raise FrameError(DropReason.NO_CHANNEL, "a hint about a channel that is not ours")
        if now_s - asked.reopened_s >= _REOPEN_S:
            self._open(sender, asked, now_s)

    # -- the queried side

    def _take_offer(self, statement: Statement, now: Timestamps) -> None:
        offered = _Open.from_statement(statement)
        if not self._accepts or offered.rib != self._identity.name:
            raise StatementError(DropReason.NOT_FOR_US, "an offer of a channel")
        known = self._askers.get(statement.signer)
        fingerprint = statement.fingerprint
        if known is not None and fingerprint in known.offers:
            self._out.append(Outgoing(statement.signer, known.offers[fingerprint].accept, is_answer=True))
            return
        if known is not None and not known.pace.spend(now.mono_s):
            raise StatementError(DropReason.QUOTA, "offers of channels")
        if self._verified(statement, now) not in _PEER_ROLES:
            raise StatementError(DropReason.NOT_DELEGATED, "only switches and RIBs ask")
        key = ExchangeKey.from_random(self._random_bytes(EXCHANGE_KEY_BYTES))
        id_ = self._random_bytes(_ID_BYTES)
        accept = self._identity.signed(_Accept(fingerprint, id_, key.public, statement.signer))
        if len(accept) > len(statement.wire):
            raise StatementError(DropReason.MALFORMED, "an offer that is shorter than its answer")
        keys = _keys(key, offered.key, fingerprint, parse(accept).fingerprint)
        asker = self._askers.setdefault(statement.signer, _Asker())
        self._askers.move_to_end(statement.signer)
        asker.offers[fingerprint] = _Channel(id=id_, out_key=keys[1], in_key=keys[0], begun_s=now.mono_s, accept=accept)
        if len(asker.offers) > _OFFERS_PER_PEER:
            asker.offers.popitem(last=False)
        if len(self._askers) > _PEERS_MAX:
            self._askers.popitem(last=False)
        self._out.append(Outgoing(statement.signer, accept, is_answer=True))

    # -- records

    def _take_record(self, record: bytes, sender: Name, now_s: float) -> bytes:
        if not RECORD_OVERHEAD_BYTES <= len(record) <= RECORD_OVERHEAD_BYTES + CONTROL_MAX_BYTES:
            raise FrameError(DropReason.MALFORMED, "a record of a channel")
        id_ = record[1 : 1 + _ID_BYTES]
        asked = self._asked.get(sender)
        if asked is not None and asked.channel is not None and asked.channel.id == id_:
            return asked.channel.open(record)
        asker = self._askers.get(sender)
        if asker is not None:
            channel = asker.channels.get(id_)
            if channel is not None:
                return channel.open(record)
            for fingerprint, offered in asker.offers.items():
                if offered.id == id_:
                    plaintext = offered.open(record)
                    del asker.offers[fingerprint]
                    asker.channels[id_] = offered
                    if len(asker.channels) > _CHANNELS_PER_PEER:
                        asker.channels.popitem(last=False)
                    return plaintext
        if self._accepts and self._hints.spend(now_s):
            self._out.append(Outgoing(sender, bytes([_UNKNOWN]) + id_, is_answer=True))
        raise FrameError(DropReason.NO_CHANNEL, "a record of a channel that is not known")

    def _verified(self, statement: Statement, now: Timestamps) -> Role:
        """Return the role of the signer.

        Raises:
            StatementError: the signer is no member of a trusted domain, or did not sign.
        """
        member = self._policy.verify_sender(statement, now.unix_s)
        statement.verify(member.key)
        return member.role


def _keys(key: ExchangeKey, far: bytes, offer: bytes, accept: bytes) -> list[RecordKey]:
    """Return the keys of both directions: from the querying end, then to it."""
    bound = [purpose + offer + accept for purpose in _PURPOSES]
    return [RecordKey(secret) for secret in key.agree(far, *bound)]
