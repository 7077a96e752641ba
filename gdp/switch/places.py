"""Where names are, as the RIB answered, and what is still to be asked.

Place: pure; time comes in as ``now_s`` (monotonic seconds).

A question is asked again until it is answered; a watched name is asked anew before its watch ends, so that a RIB which
restarted learns of the watch again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gdp.limits import NEGATIVE_LEASE_S
from gdp.names import Name
from gdp.trust.right import Right

__all__ = ["WATCH_S", "Place", "Places"]

RETRY_S: Final = 0.25
TRIES_MAX: Final = 8
QUESTIONS_MAX: Final = 4_096  # open at once; each costs a signature at every try
WATCH_S: Final = 20.0
WATCH_AGAIN_S: Final = 6.0


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


@dataclass(slots=True)
class _Question:
    ask_at_s: float
    tries: int = 0
    is_watch: bool = False
    is_answered: bool = False


class Places:
    """What one switch knows of where names are."""

    def __init__(self) -> None:
        self._places: dict[Name, dict[Name, Place]] = {}
        self._nobody: dict[Name, float] = {}
        self._questions: dict[Name, _Question] = {}
        self._watches = 0
        self._ask_at_s = float("inf")  # no question is due before
        self._expire_at_s = float("inf")  # no lease ends before

    def __len__(self) -> int:
        return len(self._places)

    def of(self, name: Name, now_s: float) -> list[Place]:
        """Return the known places of a name."""
        known = self._places.get(name)
        return [] if known is None else [place for place in known.values() if place.expires_s > now_s]

    def is_nowhere(self, name: Name, now_s: float) -> bool:
        """Return whether the RIB said a moment ago that nobody advertises the name."""
        return self._nobody.get(name, 0.0) > now_s

    def want(self, name: Name, now_s: float, *, watch: bool) -> None:
        """Have the RIB asked for a name, unless it is being asked already, or too much is.

        Watches are for readers who proved themselves, and are always taken on.
        """
        question = self._questions.get(name)
        if question is None:
            if not watch and len(self._questions) - self._watches >= QUESTIONS_MAX:
                return
            question = self._questions[name] = _Question(now_s)
            self._ask_at_s = min(self._ask_at_s, now_s)
        if watch and not question.is_watch:
            question.is_watch = True
            question.ask_at_s = now_s
            self._ask_at_s = min(self._ask_at_s, now_s)
            self._watches += 1

    def is_asked(self, name: Name) -> bool:
        """Return whether a question for a name is open."""
        return name in self._questions

    def unwatch(self, name: Name) -> None:
        """Ask for a name no more."""
        question = self._questions.pop(name, None)
        if question is not None and question.is_watch:
            self._watches -= 1

    def ask_again(self, now_s: float) -> None:
        """Have every open question and every watch asked at once: there is a new RIB."""
        for question in self._questions.values():
            question.ask_at_s, question.tries = now_s, 0
        self._ask_at_s = min(self._ask_at_s, now_s)

    def due(self, now_s: float) -> tuple[list[tuple[Name, bool]], list[Name]]:
        """Return the questions to send now, as (name, watch), and the names whose question was given up."""
        ask: list[tuple[Name, bool]] = []
        given_up: list[Name] = []
        if now_s < self._ask_at_s:
            return ask, given_up
        for name, question in list(self._questions.items()):
            if question.ask_at_s > now_s:
                continue
            if not question.is_watch and question.tries >= TRIES_MAX:
                del self._questions[name]
                given_up.append(name)
                continue
            question.tries += 1
            question.ask_at_s = now_s + (WATCH_AGAIN_S if question.is_answered else RETRY_S)
            ask.append((name, question.is_watch))
        self._ask_at_s = min((question.ask_at_s for question in self._questions.values()), default=float("inf"))
        return ask, given_up

    def next_due(self) -> float | None:
        """Return a monotonic second that is no later than the next question, or None."""
        return self._ask_at_s if self._questions else None

    def put(self, place: Place, now_s: float, *, is_ours: bool = False) -> Place | None:
        """Note a place; return what was known of this advertiser before.

        Args:
            is_ours: it is attached here. The RIB echoes a claim to who brought it, which answers no question: only
                what is told a second time does.
        """
        self._nobody.pop(place.name, None)
        known = self._places.setdefault(place.name, {})
        before = known.get(place.advertiser)
        if not is_ours or (before is not None and before.claim == place.claim):
            self._answered(place.name, now_s)
        known[place.advertiser] = place
        self._expire_at_s = min(self._expire_at_s, place.expires_s)
        return before

    def remove(self, name: Name, advertiser: Name, now_s: float) -> None:
        """Note that an advertiser is gone."""
        self._answered(name, now_s)
        known = self._places.get(name, {})
        known.pop(advertiser, None)
        if not known:
            self._places.pop(name, None)

    def nobody(self, name: Name, now_s: float) -> None:
        """Note that nobody advertises a name."""
        self._answered(name, now_s)
        self._places.pop(name, None)
        self._nobody[name] = now_s + NEGATIVE_LEASE_S
        self._expire_at_s = min(self._expire_at_s, now_s + NEGATIVE_LEASE_S)

    def expire(self, now_s: float) -> None:
        """Forget what was believed long enough."""
        if now_s < self._expire_at_s:
            return
        for name in list(self._places):
            known = self._places[name]
            for advertiser in [a for a, place in known.items() if place.expires_s <= now_s]:
                del known[advertiser]
            if not known:
                del self._places[name]
        for name in [name for name, until_s in self._nobody.items() if until_s <= now_s]:
            del self._nobody[name]
        ends = [place.expires_s for known in self._places.values() for place in known.values()]
        self._expire_at_s = min([*ends, *self._nobody.values()], default=float("inf"))

    def _answered(self, name: Name, now_s: float) -> None:
        question = self._questions.get(name)
        if question is None:
            return
        if not question.is_watch:
            del self._questions[name]
            return
        question.is_answered = True
        question.ask_at_s = now_s + WATCH_AGAIN_S
