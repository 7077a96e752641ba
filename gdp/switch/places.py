"""Where names are, as RIBs and neighbours proved, and what is still to be asked.

Place: pure; time comes in as ``now_s`` (monotonic seconds).

A question is asked again until it is answered. A name that readers here want, or that frames are sent to, is watched:
it is asked again before its watch ends, so that a RIB which restarted learns of the watch again. While no RIB answers,
what is known is served beyond its lease, until the proofs of the claim end themselves (RFC 8767 in spirit).

Questions for new names have a window: so many wait for answers at a time, and those who have them asked take turns. A
RIB is thus asked at the pace at which it answers. Without it, what is asked again because its answer waits in a queue
makes that queue longer, and nothing is answered in time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from gdp.limits import CLAIM_LEASE_S, NEGATIVE_LEASE_S, PARKED_S
from gdp.message.fair_queue import FairQueue
from gdp.names import Name
from gdp.trust.claim import Claim
from gdp.trust.right import Right

__all__ = ["AT_ONCE", "WINDOW", "Place", "Places"]

RETRY_S: Final = 0.25
TRIES_MAX: Final = 8
QUESTIONS_MAX: Final = 4_096  # open at once; each costs a signature at every try
WINDOW: Final = 128  # new names whose answers are awaited at a time; a tenth of a second's work of a RIB
AT_ONCE: Final = 64  # questions in one go, some 10 ms: a switch has other things to do
_LOOK_S: Final = 0.01  # between two looks at what is to be asked again
_WAITS: Final = float("inf")
USES_MAX: Final = 8_192  # names watched because frames are sent to them


@dataclass(frozen=True, slots=True)
class Place:
    """One advertiser of a name, and where it is attached."""

    name: Name
    advertiser: Name
    right: Right
    switch: Name
    domain: Name
    transit: frozenset[Name]  # domains through which that domain lets its traffic pass
    claim: bytes
    expires_s: float
    proof: Claim | None = None  # what was verified; None where a test makes a place by hand
    stale_until_s: float = 0.0  # the proofs hold so long: it is served until then while no RIB answers

    @property
    def sequence(self) -> int:
        """Return the sequence number of the claim, or 0."""
        return 0 if self.proof is None else self.proof.sequence


@dataclass(slots=True)
class _Question:
    ask_at_s: float  # ``_WAITS``: when it has its turn
    since_s: float
    owner: bytes = b""  # at whose expense
    tries: int = 0
    is_watch: bool = False  # a reader here wants to know of all who advertise the name
    used_until_s: float = 0.0  # frames are sent to it
    is_answered: bool = False


class Places:
    """What one switch knows of where names are.

    Args:
        watch_s: how long the RIB keeps a watch for readers unless it is renewed, which happens after a quarter of that.
            A name that frames are sent to is watched for twice as long after the last look-up.

    Attributes:
        serves_stale: no RIB answers, so leases that ended do not count.
    """

    def __init__(self, watch_s: float = CLAIM_LEASE_S) -> None:
        self.watch_s = watch_s
        self._watch_again_s = watch_s / 4
        self._use_watch_s = 2 * watch_s
        self._use_again_s = watch_s / 2
        self._places: dict[Name, dict[Name, Place]] = {}
        self._names_of: dict[Name, set[Name]] = {}  # what each advertiser advertises, of ``_places``
        self._nobody: dict[Name, float] = {}
        self._questions: dict[Name, _Question] = {}
        self._waiting = FairQueue[Name]()
        self._awaited: set[Name] = set()  # of new names, whose answers are awaited
        self._watches = 0
        self._ask_at_s = float("inf")  # no question is due before
        self._expire_at_s = float("inf")  # no lease ends before
        self.serves_stale = False

    def __len__(self) -> int:
        return len(self._places)

    def of(self, name: Name, now_s: float) -> list[Place]:
        """Return the known places of a name."""
        known = self._places.get(name)
        return [] if known is None else [place for place in known.values() if self._ends_s(place) > now_s]

    def get(self, name: Name, advertiser: Name) -> Place | None:
        """Return the place of one advertiser of a name, or None."""
        return self._places.get(name, {}).get(advertiser)

    def of_node(self, node: Name, now_s: float) -> Place | None:
        """Return the newest place of anything that a node advertises: it is attached there itself. None: not known."""
        known = (self._places[name][node] for name in self._names_of.get(node, ()))
        held = [place for place in known if self._ends_s(place) > now_s]
        return max(held, key=lambda place: place.sequence, default=None)

    def all(self) -> list[Place]:
        """Return every place."""
        return [place for known in self._places.values() for place in known.values()]

    def is_nowhere(self, name: Name, now_s: float) -> bool:
        """Return whether the RIB said a moment ago that nobody advertises the name."""
        return self._nobody.get(name, 0.0) > now_s

    def want(self, name: Name, now_s: float, *, watch: bool, owner: bytes = b"") -> None:
        """Have the RIB asked for a name, unless it is being asked already, or too much is.

        Watches are for readers who proved themselves, and are always taken on.

        Args:
            owner: at whose expense.
        """
        question = self._questions.get(name)
        if question is None:
            if not watch and len(self._questions) - self._watches >= QUESTIONS_MAX:
                return
            question = self._questions[name] = _Question(_WAITS, now_s, owner)
            if not watch:
                self._waiting.put(owner, name)
        if watch and not question.is_watch:
            self._waiting.discard(question.owner, name)
            question.is_watch = True
            question.ask_at_s = now_s
            self._ask_at_s = min(self._ask_at_s, now_s)
            self._watches += 1

    def use(self, name: Name, now_s: float) -> None:
        """Note that frames go to a name whose place is known: it is watched for a while, to hear where it moves."""
        question = self._questions.get(name)
        if question is None:
            if len(self._questions) - self._watches >= USES_MAX:
                return  # moved nodes are then learnt of by redirects alone
            question = self._questions[name] = _Question(now_s, now_s)
            self._ask_at_s = min(self._ask_at_s, now_s)
        question.used_until_s = now_s + self._use_watch_s

    def ask_now(self, name: Name, now_s: float, owner: bytes = b"") -> None:
        """Have a name asked for at once, what is known of it being wrong; ``owner`` as in ``want``."""
        self.want(name, now_s, watch=False, owner=owner)
        question = self._questions.get(name)
        if question is not None and question.is_answered:
            question.is_answered, question.tries, question.ask_at_s = False, 0, now_s
            self._ask_at_s = min(self._ask_at_s, now_s)

    def is_asked(self, name: Name) -> bool:
        """Return whether a question for a name is open."""
        return name in self._questions

    def unwatch(self, name: Name) -> None:
        """Watch a name no more on behalf of readers."""
        question = self._questions.get(name)
        if question is None:
            return
        if question.is_watch:
            question.is_watch = False
            self._watches -= 1
        if question.used_until_s == 0.0:
            self._forget(name)

    def ask_again(self, now_s: float) -> None:
        """Have every open question and every watch asked at once: there is a new RIB."""
        for question in self._questions.values():
            question.tries = 0
            if question.ask_at_s != _WAITS:
                question.ask_at_s = now_s
        self._ask_at_s = min(self._ask_at_s, now_s)

    def due(self, now_s: float) -> tuple[list[tuple[Name, float]], list[Name]]:
        """Return the questions to send now, as (name, seconds to watch it), and the names that were given up.

        At most ``AT_ONCE`` questions; more are due at once.
        """
        ask: list[tuple[Name, float]] = []
        given_up: list[Name] = []
        if now_s >= self._ask_at_s:
            self._due_again(now_s, ask, given_up)
        while len(ask) < AT_ONCE and self._has_turn():
            name = self._waiting.pop()
            question = self._questions[name]
            if now_s >= question.since_s + PARKED_S:  # what asked for it waits no more
                self._forget(name)
                given_up.append(name)
                continue
            self._awaited.add(name)
            ask.append((name, self._asked(question, now_s)))
            self._ask_at_s = min(self._ask_at_s, question.ask_at_s)
        return ask, given_up

    def _due_again(self, now_s: float, ask: list[tuple[Name, float]], given_up: list[Name]) -> None:
        """Add what was asked before, or is watched, and is due; as ``due``."""
        next_s = _WAITS
        for name, question in list(self._questions.items()):
            if question.ask_at_s <= now_s:
                is_used = question.used_until_s > now_s
                if not question.is_watch and not is_used and (question.is_answered or question.tries >= TRIES_MAX):
                    self._forget(name)
                    if not question.is_answered:
                        given_up.append(name)
                    continue
                if len(ask) >= AT_ONCE:
                    self._ask_at_s = now_s
                    return
                ask.append((name, self._asked(question, now_s)))
            next_s = min(next_s, question.ask_at_s)
        self._ask_at_s = max(next_s, now_s + _LOOK_S)

    def _asked(self, question: _Question, now_s: float) -> float:
        """Note that a question is asked now; return for how long to watch its name."""
        question.tries += 1
        if question.is_answered:
            question.ask_at_s = now_s + (self._watch_again_s if question.is_watch else self._use_again_s)
        else:
            question.ask_at_s = now_s + RETRY_S * min(2 ** (question.tries // TRIES_MAX), 8)
        return self.watch_s if question.is_watch else self._use_watch_s if question.used_until_s > now_s else 0.0

    def _has_turn(self) -> bool:
        return bool(self._waiting) and len(self._awaited) < WINDOW

    def _forget(self, name: Name) -> None:
        """Ask for a name no more."""
        self._waiting.discard(self._questions.pop(name).owner, name)
        self._awaited.discard(name)

    def next_due(self) -> float | None:
        """Return the monotonic second at which ``due`` has something to do, or an earlier one; None: not yet known."""
        if self._has_turn():
            return float("-inf")
        return self._ask_at_s if self._questions and self._ask_at_s != _WAITS else None

    def put(self, place: Place, now_s: float, *, is_ours: bool = False, has_left: bool = False) -> Place | None:
        """Note a place; return what was known of this advertiser before.

        Args:
            is_ours: it is attached here. The RIB echoes a claim to who brought it, which answers no question: only
                what is told a second time does.
            has_left: it was attached here and is no more. The RIB does not know that yet: where it went stays open.
        """
        self._nobody.pop(place.name, None)
        known = self._places.setdefault(place.name, {})
        before = known.get(place.advertiser)
        is_repeated = before is not None and before.claim == place.claim
        if not has_left and (not is_ours or is_repeated):
            self.answered(place.name, now_s)
        known[place.advertiser] = place
        self._names_of.setdefault(place.advertiser, set()).add(place.name)
        self._expire_at_s = min(self._expire_at_s, self._ends_s(place))
        return before

    def remove(self, name: Name, advertiser: Name, now_s: float) -> None:
        """Note that an advertiser is gone."""
        self.answered(name, now_s)
        self._drop(name, advertiser)

    def nobody(self, name: Name, now_s: float) -> None:
        """Note that nobody advertises a name."""
        self.answered(name, now_s)
        for advertiser in list(self._places.get(name, ())):
            self._drop(name, advertiser)
        self._nobody[name] = now_s + NEGATIVE_LEASE_S
        self._expire_at_s = min(self._expire_at_s, now_s + NEGATIVE_LEASE_S)

    def serve_stale(self, stale: bool, now_s: float) -> None:
        """Begin or end to serve what is beyond its lease.

        When a RIB answers again, what it does not confirm within ``watch_s / 2`` is let go.
        """
        if stale == self.serves_stale:
            return
        self.serves_stale = stale
        if not stale:
            for known in self._places.values():
                for advertiser, place in known.items():
                    if place.expires_s < now_s + self._use_again_s < place.stale_until_s:
                        known[advertiser] = replace(place, expires_s=now_s + self._use_again_s)
        self._look_ahead()

    def expire(self, now_s: float) -> list[Place]:
        """Forget what was believed long enough; return the places among it."""
        if now_s < self._expire_at_s:
            return []
        gone = [place for place in self.all() if self._ends_s(place) <= now_s]
        for place in gone:
            self._drop(place.name, place.advertiser)
        for name in [name for name, until_s in self._nobody.items() if until_s <= now_s]:
            del self._nobody[name]
        self._look_ahead()
        return gone

    def next_expiry(self) -> float | None:
        """Return a monotonic second that is no later than the end of what is believed, or None."""
        return None if self._expire_at_s == float("inf") else self._expire_at_s

    def _drop(self, name: Name, advertiser: Name) -> None:
        known = self._places.get(name, {})
        if known.pop(advertiser, None) is None:
            return
        if not known:
            del self._places[name]
        names = self._names_of[advertiser]
        names.discard(name)
        if not names:
            del self._names_of[advertiser]

    def _look_ahead(self) -> None:
        ends = [self._ends_s(place) for known in self._places.values() for place in known.values()]
        self._expire_at_s = min([*ends, *self._nobody.values()], default=float("inf"))

    def _ends_s(self, place: Place) -> float:
        return max(place.expires_s, place.stale_until_s) if self.serves_stale else place.expires_s

    def answered(self, name: Name, now_s: float) -> None:
        question = self._questions.get(name)
        if question is None:
            return
        if not question.is_watch and question.used_until_s <= now_s:
            self._forget(name)
            return
        self._awaited.discard(name)
        if not question.is_answered:  # what is pushed later renews no watch
            question.is_answered = True
            question.ask_at_s = now_s + (self._watch_again_s if question.is_watch else self._use_again_s)
