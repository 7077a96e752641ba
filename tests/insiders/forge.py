"""Statements of hostile members: of every type, well formed and signed by a real key, but with harmful content.

A body begins as an honest one would be at this moment of the network: its sessions, sequence numbers and names are
known to its signer. Some of its fields then take a hostile value of their own type: a boundary, another node's name
or certificate, an old statement, a list at its maximum. The honest fields let receivers accept the rest.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import count
from typing import Any, Final

from gdp.client.rib_host import RibHost
from gdp.client.writer_proxy import WriterProxyState
from gdp.control.fragments import ControlFragmenter
from gdp.control.hello import CONFLICTS_MAX, COOKIE_BYTES, COOKIES_MAX, HEARD_MAX, RTCERTS_MAX
from gdp.control.keepalive import PAYLOAD_BYTES, seal_keepalive
from gdp.control.link_quality import LinkReport
from gdp.control.link_state import COST_MAX, LINKS_MAX, MEMBERS_MAX, RIBS_MAX
from gdp.control.rib_statements import TRANSIT_MAX
from gdp.crypto import cbor
from gdp.crypto.envelope import KeyContext, Sealer
from gdp.crypto.identity import Identity
from gdp.crypto.statements import StatementType, parse, sign
from gdp.crypto.subject import NAMED_SUBJECT, SUBJECT
from gdp.crypto.validity import VALIDITY, Validity
from gdp.errors import DropReason, LocalError, StatementError
from gdp.exchange.sync_message import ASKED_MAX, ITEMS_MAX, LACKING_MAX, SETS_MAX
from gdp.exchange.sync_set import LINE_BYTES, line_of
from gdp.frame.codec import Flag, Header, Kind, encode
from gdp.intervals import DAY_S
from gdp.limits import CHAIN_MAX, HOPS_MAX, NACKS_PER_REPORT
from gdp.message import bundle
from gdp.message.acknack import AckNack, AckNackFlag, MissingRange
from gdp.message.heartbeat import STARTS_MAX, Heartbeat, StreamStart
from gdp.message.loss import GONE_MAX, LostRange
from gdp.message.renumbering import MOVES_MAX, Renumbering
from gdp.names import ZERO, Name
from gdp.switch.core import SwitchCore
from gdp.trust.adcert import AdCert
from gdp.trust.advertisement import Advertisement
from gdp.trust.revocations import hash_of
from gdp.trust.right import HEARS, Right
from gdp.trust.rtcert import RtCert
from tests.insiders.stage import PERSONAS, Persona, Place, Stage

__all__ = ["KINDS_OF_WORDS", "Forge", "Utterance"]

_U64: Final = (1 << 64) - 1
_INTEGERS: Final = (0, 1, 2, 255, 256, 65_535, 65_536, (1 << 24), (1 << 31) - 1, 1 << 32, (1 << 63), _U64 - 1, _U64)
_NUMBERS: Final = (0.0, -0.0, -1.0, 1e-9, 0.5, 1.0, 24.0, 3_599.5, 3_600.0, 3_600.5, 1e300, float("inf"), float("nan"))
_TEXTS: Final = ("", "publish", "serve", "call", "read", "attach", "domain", "border", "x" * 300)
_ASKS: Final = ("ping", "trace", "resolve", "state", "dance", "", "x" * 17)
_SIZES: Final = (900, 1_024, 1_025, 6_400, 6_500, 6_501, 12_000, 16_000, 16_300)
_MAXIMA: Final = {
    "h": HEARD_MAX, "u": CONFLICTS_MAX, "y": COOKIES_MAX,
    "l": LINKS_MAX, "i": LINKS_MAX, "m": MEMBERS_MAX, "x": TRANSIT_MAX, "r": RIBS_MAX,
    "chain": CHAIN_MAX, "p": ASKED_MAX, "e": ITEMS_MAX, "w": SETS_MAX, "rights": 4,
}  # fmt: skip
_RIGHTS: Final = tuple(Right)
_REMEMBERED: Final = 96  # old statements that are sent again, or put into others

_Body = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Utterance:
    """Frames that a persona sends into a port of its neighbour.

    Args:
        what: type of the statement, or kind of the frame.
    """

    persona: Persona
    what: str
    place: Place
    frames: tuple[bytes, ...]

    @property
    def size(self) -> int:
        """Return its bytes on the link, without Ethernet headers."""
        return sum(map(len, self.frames))


class Forge:
    """Generator of utterances for a stage; equal randomness in an equal state gives equal utterances.

    Args:
        may_break: also those of personas whose role lets them hurt the good flow.
    """

    def __init__(self, stage: Stage, *, may_break: bool = True) -> None:
        self._stage = stage
        self._personas = [each for each in PERSONAS if may_break or not each.may_break]
        world = stage.world
        self._unknown = tuple(Name(bytes([number]) * 32) for number in range(1, 9))
        self._nodes = tuple(identity.name for identity in world.identities.values())
        self._domains = tuple(each.root.domain for each in world.authorities.values())
        self._topics = (stage.flow.topic.name, *(topic.name for topic in stage.topics.values()))
        self._names = (*self._nodes, *self._domains, *self._topics, *self._unknown)
        self._certs = tuple(identity.membership for identity in world.identities.values())
        self._roots = tuple(authority.root.wire for authority in world.authorities.values())
        self._old: deque[bytes] = deque(self._recorded(), maxlen=_REMEMBERED)
        self._numbers = count(int(world.network.now.unix_s * 1_000) + 100_000)
        self._counters = count(1 << 40)
        self._splitters = {persona.node: ControlFragmenter(stage.identity(persona).name, 77) for persona in PERSONAS}
        self._sealers: dict[tuple[str, str, int], Any] = {}

    def utter(self, rng: random.Random) -> Utterance | None:
        """Return the next utterance of some persona, or None where it is cut off."""
        persona = rng.choice(self._personas)
        places = self._stage.places(persona.node)
        if not places:
            return None
        place = rng.choice(places)
        if rng.random() < 0.04:  # as a stranger, at another node's port
            ports = self._stage.world.network._nodes[place.node].ports
            mac = place.mac if rng.random() < 0.5 else b"\x02evil" + bytes([rng.randrange(4)])
            place = Place(place.node, rng.choice(list(ports)), mac)
        if rng.random() < 0.12:
            return self.say(rng, persona, rng.choice(_FRAMES)[0], place)
        type_ = rng.choice(_SPOKEN)
        kind, destination = self._delivery(rng, type_, place)
        wire = self._statement(rng, type_, persona, place)
        return None if wire is None else self._sent(rng, persona, type_, place, kind, destination, wire)

    def say(self, rng: random.Random, persona: Persona, what: str, place: Place) -> Utterance | None:
        """Return a well-formed statement of a type, or frame of a kind, as in ``KINDS_OF_WORDS``."""
        for each, make in _FRAMES:
            if each == what:
                frames = make(self, rng, persona, place)
                return Utterance(persona, what, place, tuple(frames)) if frames else None
        type_, identity = StatementType(what), self._stage.identity(persona)
        kind, destination = self._delivery(rng, type_, place)
        wire = self._signed(type_, _BODIES[type_](self, rng, identity, place), identity.name, identity.key)
        return None if wire is None else self._sent(rng, persona, type_, place, kind, destination, wire)

    def _sent(
        self, rng: random.Random, persona: Persona, type_: StatementType, place: Place, kind: int, to: Name, wire: bytes
    ) -> Utterance | None:
        """Return a statement in frames, usually in a channel if it belongs in one."""
        if kind in (Kind.RIB_REQUEST, Kind.RIB_ANSWER) and rng.random() < 0.8:
            return self._in_channel(persona, type_, place, to, wire)
        try:
            frames = self._splitters[persona.node].split(kind, wire, 1_500, to)
        except LocalError:
            return None
        self._old.append(wire)
        return Utterance(persona, type_.value, place, tuple(frames))

    def _in_channel(
        self, persona: Persona, type_: StatementType, place: Place, to: Name, wire: bytes
    ) -> Utterance | None:
        """Send a statement over the channel of the persona's own machine, or the handshake that opens one."""
        machine = self._stage.machines().get(persona.node)
        channels = getattr(machine, "_channels", None)
        if channels is None or to == ZERO:
            return None
        if not channels.send_response(to, wire):
            channels.send_query(to, wire, self._stage.world.network.now.mono_s)
        frames: list[bytes] = []
        for each in channels.records_to_send():
            kind = Kind.RIB_ANSWER if each.is_answer else Kind.RIB_REQUEST
            frames += self._splitters[persona.node].split(kind, each.wire, 1_500, each.to)
        self._old.append(wire)
        return Utterance(persona, type_.value, place, tuple(frames)) if frames else None

    # -- statements

    def _statement(self, rng: random.Random, type_: StatementType, persona: Persona, place: Place) -> bytes | None:
        if rng.random() < 0.04:
            return rng.choice(self._old)
        identity = self._stage.identity(persona)
        body = _BODIES[type_](self, rng, identity, place)
        if rng.random() < 0.6:
            for _ in range(rng.choice((1, 1, 1, 2, 3))):
                self._spoil(rng, body)
        if rng.random() < 0.05:
            body["zz"] = bytes(max(rng.choice(_SIZES) - 1_200 + rng.randrange(-2, 3), 0))
        signer, key = identity.name, identity.key
        if type_ is StatementType.REVOKE and rng.random() < 0.3:
            owner = self._stage.world.owner.key
            return self._signed(type_, {**body, "owner": owner.public.compressed}, self._topics[1], owner)
        if rng.random() < 0.03:
            signer = self._name(rng)
        return self._signed(type_, body, signer, key)

    @staticmethod
    def _signed(type_: StatementType, body: Mapping[str, object], signer: Name, key: Any) -> bytes | None:
        try:
            return sign(type_, body, signer, key)
        except LocalError:  # no CBOR, or too long
            return None

    def _spoil(self, rng: random.Random, body: _Body) -> None:
        key = rng.choice(list(body))
        chance = rng.random()
        if chance < 0.03:
            del body[key]
            body["y"] = 0
        elif chance < 0.06:
            body[key] = rng.choice((None, True, -1, 1.5, "", b"", [], {}, [[]], [b""]))
        else:
            body[key] = self._hostile(rng, key, body[key])

    def _hostile(self, rng: random.Random, key: str, value: Any) -> Any:
        if isinstance(value, bool):
            return not value
        if isinstance(value, int):
            return rng.choice((*_INTEGERS, max(value - 1, 0), min(value + 1, _U64), *self._far_numbers()))
        if isinstance(value, float):
            return rng.choice(_NUMBERS)
        if isinstance(value, str):
            return rng.choice(_TEXTS)
        if isinstance(value, list):
            return self._hostile_list(rng, key, value)
        if isinstance(value, dict):
            spoilt = dict(value)
            if spoilt:
                self._spoil(rng, spoilt)
            return spoilt
        if isinstance(value, bytes):
            if len(value) == 32:
                return self._name(rng)
            if len(value) <= 16:
                return rng.choice((bytes(len(value)), b"\xff" * len(value), rng.randbytes(len(value)), b""))
            if len(value) == 33:
                return rng.choice([identity.key.public.compressed for identity in self._identities()])
            return rng.choice((self._cert, self._old_one, self._cut, self._root))(rng, value)
        return value

    def _hostile_list(self, rng: random.Random, key: str, value: list[Any]) -> list[Any]:
        most = _MAXIMA.get(key, 64)
        items = value or [self._name(rng)]
        chance = rng.random()
        if chance < 0.15:
            return []
        if chance < 0.4:
            at = rng.randrange(len(items))
            return [*items[:at], self._hostile(rng, key, items[at]), *items[at + 1 :]]
        size = rng.choice((1, 2, most - 1, most, most + 1))
        if chance < 0.6:
            return (items * (size // len(items) + 1))[:size]  # encode it in any case
        return [self._like(rng, rng.choice(items)) for _ in range(size)]

    def _like(self, rng: random.Random, item: Any) -> Any:
        """Return another item of the same form, with new names in it."""
        if isinstance(item, bytes) and len(item) == 32:
            return rng.choice((self._name(rng), Name(rng.randbytes(32))))
        if isinstance(item, bytes) and len(item) > 64:
            return item if rng.random() < 0.5 else rng.randbytes(64) + item[64:]
        if isinstance(item, bytes):
            return rng.randbytes(len(item))
        if isinstance(item, list):
            return [self._like(rng, each) for each in item]
        if isinstance(item, int) and not isinstance(item, bool):
            return rng.choice((1, item, COST_MAX))
        return item

    def _cert(self, rng: random.Random, _: bytes) -> bytes:
        return rng.choice(self._certs)

    def _root(self, rng: random.Random, _: bytes) -> bytes:
        return rng.choice(self._roots)

    def _old_one(self, rng: random.Random, _: bytes) -> bytes:
        return rng.choice(self._old)

    def _cut(self, rng: random.Random, value: bytes) -> bytes:
        return value[: rng.randrange(len(value))]

    def _far_numbers(self) -> tuple[int, ...]:
        now_ms = int(self._stage.world.network.now.unix_s * 1_000)
        limit = now_ms + int(366 * DAY_S * 1_000)
        return now_ms, now_ms - 3_600_000, limit - 1, limit, limit + 1

    def _name(self, rng: random.Random) -> Name:
        chance = rng.random()
        if chance < 0.06:
            return ZERO
        return Name(rng.randbytes(32)) if chance < 0.2 else rng.choice(self._names)

    def _identities(self) -> list[Identity]:
        return list(self._stage.world.identities.values())

    def _recorded(self) -> list[bytes]:
        """Return statements of honest nodes: advertisements that switches store."""
        switches = self._stage.world.switches.values()
        return [each.advertisement.wire for switch in switches for each in switch.attached.all()]

    def _publishers(self) -> list[Advertisement]:
        """Return the advertisements, of honest nodes too, that a join can show."""
        switches = self._stage.world.switches.values()
        advertisements = [each.advertisement for switch in switches for each in switch.attached.all()]
        return [advertisement for advertisement in advertisements if advertisement.right in HEARS.values()]

    # -- honest bodies

    def _nonce(self, place: Place) -> bytes:
        return self._stage.nonce_at(place)

    def _echo(self, place: Place) -> bytes:
        return self._stage.echo_at(place)

    def _own_nonce(self, identity: Identity, place: Place) -> bytes:
        persona = next(each for each in PERSONAS if self._stage.identity(each).name == identity.name)
        return self._stage.own_nonce(persona, place)

    def _own_incarnation(self, identity: Identity, rng: random.Random) -> bytes:
        """Return the incarnation of the persona's machine, usually the present one, else an older or a newer one."""
        machine = next((each for each in self._stage.machines().values() if each.name == identity.name), None)
        hello_protocol = getattr(machine, "hello_protocol", None) or getattr(
            getattr(machine, "attachment", None), "hello_protocol", None
        )
        incarnation_id = bytes(16) if hello_protocol is None else hello_protocol._incarnation_id
        return incarnation_id if rng.random() < 0.9 else rng.choice((bytes(16), b"\xff" * 16, rng.randbytes(16)))

    def _hello(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        nonce = rng.choice((bytes([1]) * 8, bytes([2]) * 8, rng.randbytes(8)))
        validity = self._lasting()
        switches = [each.name for each in self._stage.world.switches.values()]
        rtcerts = [RtCert.make(identity, rng.choice(switches), validity) for _ in range(rng.choice((0, 1, 2)))]
        return {
            "n": nonce, "s": next(self._counters), "h": [self._echo(place)] if rng.random() < 0.8 else [],
            "m": 1_500, "d": rng.choice((bytes(8), rng.randbytes(8))), "c": identity.membership,
            "k": rng.choice(([1_000, 1_000, 3], [0, 0, 1], [1, 1, 1], [60_000, 60_000, 255])),
            "x": rng.choice((b"", bytes(32), b"\xff" * 32, rng.randbytes(32))),
            "b": self._own_incarnation(identity, rng),
            "u": [self._echo(place)] if rng.random() < 0.1 else [], "r": rtcerts[:RTCERTS_MAX],
            "y": [self._nonce(place) + rng.randbytes(COOKIE_BYTES)] if rng.random() < 0.2 else [],
        }  # fmt: skip

    def _link_state(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        world = self._stage.world
        own = identity.root.domain

        def adjacency() -> list[Any]:
            other = rng.choice(self._identities())
            return [other.name, other.root.domain, rng.choice((1, 10, 100, COST_MAX)), rng.choice((1, 576, 1_500))]

        def rib() -> list[Any]:
            other = rng.choice([identity, *(world.identities[f"rib:{label}"] for label in world.ribs)])
            # no honest node signs a statement that it did not send
            accomplice = self._stage.identity(rng.choice(PERSONAS))
            proof = RtCert.make(rng.choice((identity, accomplice)), identity.name, self._lasting())
            other = accomplice if rng.random() < 0.3 else other
            return [other.name, other.root.domain, rng.randbytes(8), rng.randbytes(16), other.membership, proof]

        return {
            "o": rng.choice(("domain", "border")), "s": next(self._numbers),
            "l": [adjacency() for _ in range(rng.choice((0, 1, 3, 8)))],
            "i": [adjacency() for _ in range(rng.choice((0, 0, 1, 3)))],
            "r": [rib() for _ in range(rng.choice((0, 1, 2)))],
            "m": [rng.choice(self._nodes) for _ in range(rng.choice((0, 1, 4)))],
            "z": rng.random() < 0.2, "b": self._own_incarnation(identity, rng),
            "e": int(world.network.now.unix_s),
            "u": [rng.choice(self._nodes)] if rng.random() < 0.2 else [], "c": identity.membership,
            **({"d": own} if rng.random() < 0.01 else {}),
        }  # fmt: skip

    def _join(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        world = self._stage.world
        switch = rng.choice([each for each in self._identities() if each.role.value == "switch"])
        advertisements = [each for each in self._old if b"read" in each or b"serve" in each or b"call" in each]
        shown = self._publishers()
        if shown and rng.random() < 0.8:  # like an honest switch below
            advertisement = rng.choice(shown)
            topic, publisher, place_of = advertisement.name, advertisement.node, advertisement.switch
            version, proof = advertisement.sequence, advertisement.wire
        else:
            topic, publisher, place_of = rng.choice(self._topics), rng.choice(self._nodes), switch.name
            version = rng.choice((0, int(world.network.now.unix_s * 1_000), next(self._numbers)))
            proof = rng.choice((b"", *(each.wire for each in shown)))
        right = rng.choice((Right.READ, Right.READ, Right.SERVE, Right.CALL))
        evidence = (
            rng.choice(advertisements)
            if advertisements and rng.random() < 0.3
            else self._advertisement_of(rng, identity, topic, right)
        )
        return {
            "n": topic, "p": publisher,
            "w": place_of if rng.random() < 0.9 else switch.name, "d": switch.root.domain,
            "x": sorted({*self._domains, identity.root.domain}), "m": rng.choice((1_500, 576, 1, 9_000)),
            "l": rng.choice((0.0, 1.0, 7.0, 3_600.0)), "e": evidence, "i": self._echo(place),
            "s": next(self._numbers), "v": version if rng.random() < 0.9 else next(self._numbers),
            "b": rng.choice((ZERO, ZERO, rng.choice(self._nodes))), "o": self._own_nonce(identity, place),
            "c": proof,
        }  # fmt: skip

    def _join_refresh(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        """Return numbers of joins: invented ones, and those of statements that it sent as joins."""
        newest = next(self._numbers)
        numbers = [self._number(rng), *range(newest - rng.choice((0, 1, 20, 127)), newest)][:128]
        return {
            "i": self._echo(place), "o": self._own_nonce(identity, place), "s": next(self._numbers),
            "k": b"".join(min(max(number, 0), _U64).to_bytes(8, "big") for number in numbers), "u": rng.random() < 0.5,
        }  # fmt: skip

    def _pace(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        return {
            "n": rng.choice(self._topics), "p": rng.choice(self._nodes), "q": rng.choice((0, 1, 100, 255, 256)),
            "i": self._echo(place), "o": self._own_nonce(identity, place), "s": next(self._numbers),
        }  # fmt: skip

    def _advertisement(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        right = rng.choice(_RIGHTS)
        return self._advertisement_body(rng, identity, rng.choice(self._topics), right, self._switch_at(rng, place))

    def _advertisement_body(
        self, rng: random.Random, identity: Identity, topic: Name, right: Right, switch: Name
    ) -> _Body:
        """Return an advertisement of the node's own name, of a delegated topic, or of a name of its own making."""
        now = self._stage.world.network.now.unix_s
        subject, chain = identity.subject, []
        mine = [each for key, each in self._stage.topics.items() if each.delegation.node == identity.name]
        chance = rng.random()
        if right is Right.ATTACH:
            pass
        elif mine and chance < 0.6:
            delegation = rng.choice(mine).delegation
            subject, chain = delegation.subject, list(delegation.chain)
        else:  # a name that this node owns: in any number
            own = type(subject)(rng.randbytes(32), identity.key.public.compressed)
            subject = own
            if chance < 0.75:
                validity = Validity(int(now) - 10, int(now) + 1_000)
                chain = (
                    [AdCert.make(identity.key, own.name, own, identity.subject, list(_RIGHTS)[:3], validity)]
                    if Right.ATTACH not in list(_RIGHTS)[:3]
                    else []
                )
        return {
            **NAMED_SUBJECT.to_fields(subject), "right": right.value, "seq": next(self._numbers),
            "inc": int.from_bytes(self._own_incarnation(identity, rng)[8:], "big"),
            "x": rng.choice((b"", bytes(32), rng.randbytes(32))),
            "lease": rng.choice((1_000, 6_000, 24_000, 3_600_000)),
            "global": rng.random() < 0.5, "member": identity.membership, "chain": chain,
            "rt": RtCert.make(identity, switch, self._lasting()),
            **({"prev": self._switch_at(rng, None)} if rng.random() < 0.2 else {}),
        }  # fmt: skip

    def _advertisement_of(self, rng: random.Random, identity: Identity, topic: Name, right: Right) -> bytes:
        body = self._advertisement_body(rng, identity, topic, right, self._switch_at(rng, None))
        if rng.random() < 0.2:
            self._spoil(rng, body)
        return self._signed(StatementType.ADVERTISE, body, identity.name, identity.key) or b""

    def _switch_at(self, rng: random.Random, place: Place | None) -> Name:
        switches = self._stage.world.switches
        if place is not None and place.node in switches and rng.random() < 0.9:
            return switches[place.node].name
        return rng.choice(list(switches.values())).name

    def _withdraw(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        own = (identity.name, *self._topics)
        return {"n": rng.choice(own), "right": rng.choice(_RIGHTS).value, "s": next(self._numbers)}

    def _inner(self, rng: random.Random, identity: Identity) -> bytes:
        """Return an advertisement or a withdrawal, of this node or another insider, for use in another statement."""
        other = self._stage.identity(rng.choice(PERSONAS)) if rng.random() < 0.5 else identity
        chance = rng.random()
        if chance < 0.2:
            return rng.choice(self._old)
        if chance < 0.35:
            body = self._withdraw(rng, other, Place("", 0, b""))
            return self._signed(StatementType.WITHDRAW, body, other.name, other.key) or b""
        switch = self._relay_switch(rng, identity)
        body = self._advertisement_body(rng, other, rng.choice(self._topics), rng.choice(_RIGHTS), switch)
        return self._signed(StatementType.ADVERTISE, body, other.name, other.key) or b""

    def _relay_switch(self, rng: random.Random, identity: Identity) -> Name:
        is_switch = identity.role.value == "switch"
        return identity.name if is_switch and rng.random() < 0.8 else self._switch_at(rng, None)

    def _relay(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        return {
            "q": self._inner(rng, identity), "x": list(self._domains),
            "d": rng.choice((b"", rng.choice(self._domains))), "c": identity.membership,
        }  # fmt: skip

    def _query(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        watch_s = rng.choice((0.0, 0.0, 1.0, 24.0, 3_600.0))
        return {"n": rng.choice((*self._topics, self._name(rng))), "w": watch_s, "c": identity.membership}

    def _answer(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        advertisement, name, advertiser = b"", rng.choice((*self._topics, *self._nodes)), rng.choice(self._nodes)
        chance = rng.random()
        if chance < 0.6:
            advertisement = self._inner(rng, identity)
            try:
                statement = parse(advertisement)
                name, advertiser = NAMED_SUBJECT.read(statement.fields).name, statement.signer
            except StatementError:
                pass
        elif chance < 0.8:
            advertiser = name
        return {
            "n": name, "a": advertiser, "q": advertisement, "s": rng.choice((0, next(self._numbers))),
            "d": rng.choice(self._domains), "x": list(self._domains), "l": rng.choice((0.0, 0.5, 6.0, 3_600.0)),
            "c": identity.membership,
        }  # fmt: skip

    def _ack(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        return {
            "n": rng.choice((*self._topics, *self._nodes)), "a": rng.choice(self._nodes),
            "r": rng.choice((255, *(int(each) for each in DropReason), 200)), "s": next(self._numbers),
            "c": identity.membership,
        }  # fmt: skip

    def _presence(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        return {
            "n": rng.choice(self._nodes), "i": rng.randrange(40), "w": self._switch_at(rng, None),
            "q": rng.random() < 0.5, "y": rng.random() < 0.5, "c": identity.membership,
        }  # fmt: skip

    def _endpoints(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        kinds = ("host", "srflx", "public", "tls", "guess")
        endpoints = (b"\xc0\0\x02\x07\xca\x6c", bytes(18), b"\0" * 5, rng.randbytes(18))
        candidates = [
            [rng.randrange(3), rng.choice(kinds), rng.choice(endpoints)] for _ in range(rng.choice((0, 1, 17)))
        ]
        return {
            "k": [rng.randbytes(32) for _ in range(rng.choice((0, 1, 2, 5)))], "a": candidates,
            "s": self._number(rng), "u": self._number(rng), "c": identity.membership,
        }  # fmt: skip

    def _mail(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        return {
            "to": rng.choice(self._nodes), "k": rng.choice(("delegation", "a-b", "")), "s": self._number(rng),
            "b": rng.randbytes(rng.choice((0, 1, 2_000))), "c": identity.membership,
        }  # fmt: skip

    def _sync(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        """Return totals, a request or a reply, with the session of a neighbour and the certificate of a RIB."""
        sets = (
            b"routes",
            b"endpoints",
            *(hash_of(each.key.public.compressed) for each in self._stage.world.authorities.values()),
        )
        spoken = {
            "d": rng.choice(sets), "c": identity.membership, "i": self._echo(place), "s": next(self._numbers),
        }  # fmt: skip
        chance = rng.random()
        if chance < 0.3:
            totals = [[each, rng.choice((bytes(8), rng.randbytes(8)))] for each in rng.sample(sets, len(sets))]
            return {**spoken, "d": b"", "w": totals}
        prefixes = [rng.randbytes(rng.choice((0, 1, 1, 2, 32))) for _ in range(rng.choice((1, 16, LACKING_MAX)))]
        if chance < 0.4:  # as a switch asks for endpoints, or a RIB for its
            numbers = [rng.choice((0, 1, _U64)) for _ in range(rng.choice((1, 64, 65)))]
            lacking = [[name, line_of(name, each)] for each in numbers if (name := rng.choice(self._nodes))]
            refused = {"x": rng.choice((255, 28, 31, 200))} if rng.random() < 0.3 else {}
            return {**spoken, **refused, "d": b"endpoints", "l": lacking, "e": [self._endpoint_item(rng, identity)]}
        if chance < 0.6:
            lines = [rng.randbytes(LINE_BYTES * rng.choice((0, 0, 1, 30))) for _ in prefixes[:20]]
            lacking = [[each, line] for each, line in zip(prefixes, lines, strict=False)]
            return {**spoken, "l": lacking, "p": [rng.randbytes(1)[: rng.randrange(2)] for _ in prefixes[:16]]}
        makes = self._entry, self._endpoint_item
        items = [rng.choice(makes)(rng, identity) for _ in range(rng.choice((0, 1, 1, 3)))]
        hashes = [[rng.randbytes(1)[: rng.randrange(2)], rng.randbytes(2_048)] for _ in range(rng.choice((0, 1, 2)))]
        return {**spoken, "e": items, "h": hashes, "z": rng.random() < 0.5, "r": rng.choice((0, 1, LACKING_MAX))}

    def _endpoint_item(self, rng: random.Random, identity: Identity) -> bytes:
        body = self._endpoints(rng, identity, Place("", 0, b""))
        record = identity.sign(StatementType.ENDPOINTS, body) if rng.random() < 0.7 else rng.randbytes(40)
        return rng.choice((0, 1, 60_000, (1 << 32) - 1)).to_bytes(4, "big") + record

    def _entry(self, rng: random.Random, identity: Identity) -> bytes:
        unix_s = int(self._stage.world.network.now.unix_s)
        spoken: _Body = {
            "q": self._inner(rng, identity), "m": rng.choice((b"", rng.choice(self._certs))),
            "w": rng.choice(self._nodes), "d": rng.choice(self._domains), "v": rng.choice(self._domains),
            "x": list(self._domains), "l": rng.choice((0.0, 6.0, 3_600.0)), "u": rng.random() < 0.3,
            "t": rng.choice((0, unix_s + 100, _U64)),
        }  # fmt: skip
        if rng.random() < 0.3:
            self._spoil(rng, spoken)
        try:
            return cbor.encode(spoken)
        except LocalError:
            return b""

    def _revoke(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        unix_s = int(self._stage.world.network.now.unix_s)
        member = rng.choice(self._identities()).member
        until = rng.choice((unix_s, unix_s + 100, _U64, 0, member.validity.not_after_unix_s))
        return {
            **SUBJECT.to_fields(identity.subject),
            "cert": rng.choice((rng.randbytes(32), member.fingerprint)),
            "until": until,
        }

    def _open(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        to = rng.choice([host.name for host in self._stage.world.ribs.values()])
        return {"k": rng.randbytes(32), "w": to, "c": identity.membership, "p": bytes(rng.choice((0, 700, 8_000)))}

    def _accept(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        to = rng.choice(self._nodes)
        return {
            "o": rng.randbytes(32),
            "i": rng.randbytes(8),
            "k": rng.randbytes(32),
            "w": to,
            "c": identity.membership,
        }

    def _diagnostic_request(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        return {
            "a": rng.choice(_ASKS), "n": rng.choice((ZERO, *self._topics, self._name(rng))),
            "to": rng.choice((*self._nodes, self._switch_at(rng, place))), "s": self._sequence(rng),
            "b": rng.choice(({}, {"x": rng.choice(_SIZES)}, {"n": [self._name(rng)] * 40})), "k": rng.random() < 0.5,
            "c": identity.membership, "z": bytes(rng.choice((0, 1, 360, 1_040, *_SIZES))),
        }  # fmt: skip

    def _diagnostic_reply(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        return {
            "a": rng.choice(_ASKS), "s": self._sequence(rng), "r": rng.choice(self._nodes),
            "b": rng.choice(({}, {"l": [self._name(rng)] * rng.choice((1, 100))}, {"state": _TEXTS[-1]})),
            "e": rng.choice(("", "", "refused", "x" * 33)), "w": rng.random() < 0.5, "m": rng.random() < 0.5,
            "h": rng.choice((0, 1, HOPS_MAX, 63)), "c": identity.membership,
        }  # fmt: skip

    def _sequence(self, rng: random.Random) -> int:
        """Return a sequence number: one that follows from the wall clock, as honest nodes start with, or another."""
        unix_ms = int(self._stage.world.network.now.unix_s * 1_000)
        return rng.choice((unix_ms + next(self._counters), unix_ms, *self._far_numbers(), *_INTEGERS))

    def _adcert(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        return dict(parse(AdCert.make(
            identity.key, identity.name, identity.subject, rng.choice(self._identities()).subject,
            [Right.READ, Right.PUBLISH], self._lasting(),
        )).fields)  # fmt: skip

    def _rtcert(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        return {"switch": self._switch_at(rng, None), **VALIDITY.to_fields(self._lasting())}

    def _card(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        return {"member": identity.membership, "kem": identity.kem.public.wire}

    def _grant(self, rng: random.Random, identity: Identity, place: Place) -> _Body:
        return {
            **SUBJECT.to_fields(identity.subject),
            "to": rng.choice(self._nodes),
            "epoch": 1,
            "sealed": bytes(1_168),
        }

    def _lasting(self) -> Validity:
        unix_s = int(self._stage.world.network.now.unix_s)
        return Validity(unix_s // 600 * 600 - 600, unix_s // 600 * 600 + 1_800)

    # -- framing

    def _delivery(self, rng: random.Random, type_: StatementType, place: Place) -> tuple[int, Name]:
        """Return the kind of frame that carries a statement, and its addressee."""
        if rng.random() < 0.03:
            return rng.choice(tuple(Kind)), rng.choice((ZERO, self._name(rng)))
        kind = rng.choice(_KINDS[type_])
        if type_ in (StatementType.DIAGNOSTIC_REQUEST, StatementType.DIAGNOSTIC_REPLY):
            return kind, rng.choice((*self._nodes, *(each.name for each in self._stage.world.switches.values())))
        if kind >= Kind.HELLO:
            return kind, ZERO
        world = self._stage.world
        if kind == Kind.RIB_REQUEST:
            return kind, rng.choice([host.name for host in world.ribs.values()])
        hosts: list[SwitchCore | RibHost] = [*world.switches.values()]
        if kind == Kind.RIB_ANSWER:
            hosts += world.ribs.values()
        return kind, rng.choice(hosts).name

    # -- frames that carry no statement

    def _header(self, rng: random.Random, kind: int, to: Name, source: Name, length: int) -> Header:
        return Header(kind, Flag.LAST, HOPS_MAX, 1, length, next(self._counters), 0, 1, 77, to, source)

    def _keepalive(self, rng: random.Random, persona: Persona, place: Place) -> list[bytes]:
        """Return a keepalive sealed with the key of the persona's own session."""
        machine = self._stage.machines().get(persona.node)
        hello_protocol = getattr(machine, "hello_protocol", None) or getattr(
            getattr(machine, "attachment", None), "hello_protocol", None
        )
        sessions = (
            [each.keepalives for each in hello_protocol.neighbours.all_up() if each.keepalives]
            if hello_protocol
            else []
        )
        if not sessions:
            return []
        number = rng.choice((*_INTEGERS, next(self._counters)))
        source = self._stage.identity(persona).name
        header = Header(Kind.KEEPALIVE, Flag.LAST, HOPS_MAX, 0, PAYLOAD_BYTES, number, 0, 1, 77, ZERO, source)
        key = rng.choice(sessions).out_key
        counts = 0, 1, next(self._counters), 2**64 - 1
        report = LinkReport(rng.choice(counts), rng.choice(counts), rng.choice((0, 1, 2**32 - 1)), rng.randrange(256))
        multiplier = rng.choice((0, 1, 3, 255))
        return [seal_keepalive(key, header, rng.randrange(256), multiplier, rng.randbytes(8), report)]

    def _miss(self, rng: random.Random, persona: Persona, place: Place) -> list[bytes]:
        """Return a frame to some name, in the persona's or another's name."""
        source = rng.choice((self._stage.identity(persona).name, self._name(rng)))
        kind = rng.choice((Kind.DATA, Kind.ACKNACK, Kind.HEARTBEAT, Kind.RIB_REQUEST, Kind.ECHO_REPLY))
        payload = bytes(rng.choice((0, 1, 100, 1_300)))
        header = self._header(rng, kind, self._name(rng), source, len(payload))
        return [encode(header._replace(hops_left=rng.choice((0, 1, 2, HOPS_MAX, 255)))) + payload]

    def _echo_request(self, rng: random.Random, persona: Persona, place: Place) -> list[bytes]:
        source = rng.choice((self._stage.identity(persona).name, self._name(rng)))
        payload = bytes(rng.choice((0, 100, 1_300)))
        to = rng.choice((self._switch_at(rng, place), self._name(rng)))
        return [encode(self._header(rng, Kind.ECHO_REQUEST, to, source, len(payload))) + payload]

    def _report(self, rng: random.Random, persona: Persona, place: Place) -> list[bytes]:
        """Return a hostile control datagram of a reader's own writer proxy, by the key agreed with its publisher."""
        member = self._stage.world.members.get(persona.node)
        writer_proxies = (
            []
            if member is None
            else [each for each in member.subscriptions.writer_proxies() if each.state is WriterProxyState.LIVE]
        )
        if not writer_proxies:
            return []
        missing = tuple(
            MissingRange(self._number(rng), *(rng.choice((0, 1, 1 << 17, 0xFFFF_FFFF)) for _ in range(2)))
            for _ in range(rng.choice((0, 1, NACKS_PER_REPORT)))
        )
        acknack = AckNack(
            rng.choice(tuple(AckNackFlag)), self._number(rng), rng.choice((0, 1, 0xFFFF_FFFF)), missing,
            self._number(rng), self._number(rng),
        )  # fmt: skip
        writer_proxy = rng.choice(writer_proxies)
        return [writer_proxy._sealer.seal(acknack)]

    def _status(self, rng: random.Random, persona: Persona, place: Place) -> list[bytes]:
        """Return a control datagram of a publisher or a server about its stream."""
        identity = self._stage.identity(persona)
        found = self._secret(rng, identity)
        if found is None:
            return []
        topic, epoch, secret = found
        readers = [self._stage.world.members[label] for label in ("nuc2/reader", "nuc4/alien", "evil/guest")]
        starts = {
            bytes(rng.choice(readers).name): StreamStart(
                rng.choice(readers).attachment._incarnation, self._number(rng), self._number(rng), self._number(rng)
            )
            for _ in range(rng.choice((0, 1, 3)))
        }
        if rng.random() < 0.05:
            starts |= {rng.randbytes(32): StreamStart(1, 1, 1) for _ in range(STARTS_MAX - len(starts))}
        sent = self._number(rng)
        status = Heartbeat(
            rng.choice((0, 1, sent, max(sent - 1, 0))), sent, rng.choice((0, 1, 0xFFFF_FFFF)), starts,
            rng.choice((b"", b"described", bytes(1_000))),
            tuple(Renumbering(self._number(rng) % (1 << 60), rng.choice((0, 1, 1 << 32)), self._number(rng) % (1 << 61))
                  for _ in range(rng.choice((0, 0, 1, MOVES_MAX)))),
            self._number(rng), self._number(rng),
            tuple(LostRange(first, first + rng.choice((0, 1, 1 << 40)), rng.randrange(1, 4))  # type: ignore[arg-type]
                  for first in (self._number(rng) % (1 << 62) for _ in range(rng.choice((0, 0, 1, GONE_MAX))))),
        )  # fmt: skip
        return self._sealed(rng, identity, topic, epoch, secret, Kind.HEARTBEAT, status.to_wire())

    def _data(self, rng: random.Random, persona: Persona, place: Place) -> list[bytes]:
        identity = self._stage.identity(persona)
        found = self._secret(rng, identity)
        if found is None:
            return []
        body = self._number(rng).to_bytes(8, "big") + rng.randbytes(rng.choice((0, 1, 200, 5_000)))
        if rng.random() < 0.3:
            body = self._number(rng).to_bytes(8, "big") + bundle.pack([b"a"] * rng.choice((1, 3, 200)))
        return self._sealed(rng, identity, *found, Kind.DATA, body)

    def _sealed(
        self, rng: random.Random, identity: Identity, topic: Name, epoch: int, secret: bytes, kind: Kind, body: bytes
    ) -> list[bytes]:
        members = self._stage.world.members.values()
        own = next((each for each in members if each.name == identity.name), None)
        incarnation = 1 if own is None else own.attachment._incarnation
        number = self._number(rng) if rng.random() < 0.2 else next(self._numbers)
        sealer = Sealer(
            secret=secret,
            epoch=epoch,
            context=KeyContext(kind, identity.name, incarnation, topic),
            signer=identity.key,
            random_bytes=rng.randbytes,
        )
        flags = rng.choice((0, Flag.RELIABLE, Flag.RELIABLE | Flag.LATCHED, Flag.BUNDLE | Flag.RELIABLE, 0xFE))
        try:
            frames = list(sealer.seal(min(number, _U64 - 1), int(flags), body, 1_400))
        except LocalError:
            return []
        if len(frames) > 1 and rng.random() < 0.3:
            frames.pop(rng.randrange(len(frames)))
        return frames

    def _secret(self, rng: random.Random, identity: Identity) -> tuple[Name, int, bytes] | None:
        mine = [each for each in self._stage.topics.values() if each.delegation.node == identity.name]
        if not mine:
            return None
        topic = rng.choice(mine)
        epoch, secret = next(iter(topic.secrets.items()))
        return topic.name, epoch, secret

    def _number(self, rng: random.Random) -> int:
        return rng.choice((0, 1, 2, 3, 100, next(self._numbers), (1 << 63), _U64 - 2, _U64 - 1, _U64))


_T = StatementType
_Make = Callable[[Forge, random.Random, Identity, Place], _Body]
_BODIES: Final[dict[StatementType, _Make]] = {
    _T.HELLO: Forge._hello, _T.LINK_STATE: Forge._link_state, _T.JOIN: Forge._join,
    _T.JOIN_REFRESH: Forge._join_refresh, _T.PACE: Forge._pace,
    _T.ADVERTISE: Forge._advertisement,
    _T.WITHDRAW: Forge._withdraw, _T.RELAY: Forge._relay, _T.QUERY: Forge._query, _T.ANSWER: Forge._answer,
    _T.ADVERTISE_ACK: Forge._ack, _T.PRESENCE: Forge._presence, _T.SYNC: Forge._sync, _T.REVOKE: Forge._revoke,
    _T.OPEN: Forge._open, _T.ACCEPT: Forge._accept,
    _T.ADCERT: Forge._adcert, _T.RTCERT: Forge._rtcert, _T.CARD: Forge._card, _T.GRANT: Forge._grant,
    _T.ENDPOINTS: Forge._endpoints, _T.MAIL: Forge._mail,
    _T.DIAGNOSTIC_REQUEST: Forge._diagnostic_request, _T.DIAGNOSTIC_REPLY: Forge._diagnostic_reply,
}  # fmt: skip
_K = Kind
_KINDS: Final[dict[StatementType, tuple[Kind, ...]]] = {
    _T.HELLO: (_K.HELLO,), _T.LINK_STATE: (_K.LINK_STATE,), _T.JOIN: (_K.JOIN, _K.JOIN, _K.LEAVE),
    _T.JOIN_REFRESH: (_K.JOIN_REFRESH,), _T.PACE: (_K.PACE,),
    _T.ADVERTISE: (_K.ADVERTISE,), _T.WITHDRAW: (_K.WITHDRAW,),
    _T.RELAY: (_K.RIB_REQUEST, _K.RIB_REQUEST, _K.RELOCATE, _K.REDIRECT), _T.QUERY: (_K.RIB_REQUEST, _K.WHERE),
    _T.ANSWER: (_K.RIB_ANSWER, _K.RIB_ANSWER, _K.ADVERTISE_ACK, _K.REDIRECT),
    _T.ADVERTISE_ACK: (_K.ADVERTISE_ACK, _K.RIB_ANSWER),
    _T.PRESENCE: (_K.RIB_ANSWER, _K.RIB_REQUEST, _K.ADVERTISE_ACK),
    _T.SYNC: (_K.RIB_REQUEST, _K.RIB_ANSWER, _K.REVOKED),
    _T.REVOKE: (_K.REVOKE,), _T.ADCERT: (_K.ADVERTISE,), _T.RTCERT: (_K.ADVERTISE,), _T.CARD: (_K.ADVERTISE,),
    _T.GRANT: (_K.ADVERTISE_ACK,), _T.OPEN: (_K.RIB_REQUEST,), _T.ACCEPT: (_K.RIB_ANSWER,),
    _T.ENDPOINTS: (_K.RIB_REQUEST,),
    _T.MAIL: (_K.RIB_REQUEST, _K.RIB_ANSWER), _T.DIAGNOSTIC_REQUEST: (_K.DIAGNOSTIC_REQUEST,),
    _T.DIAGNOSTIC_REPLY: (_K.DIAGNOSTIC_REPLY, _K.DIAGNOSTIC_REPLY, _K.DIAGNOSTIC_REQUEST),
}  # fmt: skip
_RARE: Final = {_T.ADCERT, _T.RTCERT, _T.CARD, _T.GRANT}
_SPOKEN: Final = tuple(each for each in _BODIES for _ in range(1 if each in _RARE else 6))
_FRAMES: Final[tuple[tuple[str, Callable[[Forge, random.Random, Persona, Place], list[bytes]]], ...]] = (
    ("keepalive", Forge._keepalive),
    ("frame", Forge._miss),
    ("echo", Forge._echo_request),
    ("note", Forge._report),
    ("status", Forge._status),
    ("data", Forge._data),
)
assert set(_BODIES) == set(StatementType)
KINDS_OF_WORDS: Final = (*(each.value for each in StatementType), *(what for what, _ in _FRAMES))
