"""Trial of the insiders: a journey brings the network into some state, then hostile members send statements.

A ``Plan`` prints itself; given back to ``Trial`` it repeats the trial, keys included. Each act and each utterance is
drawn from a number of its own, so that irrelevant ones can be left out (``shrunk``).

The invariants are: no error of our own leaves a machine; no table exceeds its bound; the effect of an utterance is in
proportion to its bytes; and, unless an insider's role lets it do harm, the good flow delivers in time.
"""

from __future__ import annotations

import random
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Final
from unittest import mock

from gdp.errors import LocalError
from tests.insiders.forge import Forge, Utterance
from tests.insiders.network import Echo, TracingNetwork
from tests.insiders.oracle import signing_oracle
from tests.insiders.stage import GOOD, PARTS, PERSONAS, PROMISE_S, Stage
from tests.insiders.tables import GENERAL_MAX, LIMITS, sizes

__all__ = ["BrokenError", "Figures", "Plan", "Trial", "prepared", "shrunk"]

STRANGERS_MAX: Final = 1.0  # bytes caused by each byte of an unproven sender
_LOOK_EVERY: Final = 2_000  # utterances between two checks of the tables
_GOOD_EVERY: Final = 100  # ... and between two messages of the good flow
_PAUSES_S: Final = (*[0.0] * 80, *[0.0005] * 10, *[0.002] * 9, 0.05)  # after an utterance; others follow without delay
_ECHO_S: Final = 0.01  # after which the effect of an utterance has been counted
_ACT_CHANCE: Final = 0.002  # of an act between two utterances of a stormy trial
_HEALED_S: Final = 12.0  # leases, once all works again


class BrokenError(AssertionError):
    """Raised when an invariant does not hold."""


@dataclass(frozen=True)
class Plan:
    """Script of a trial.

    Args:
        seed: of keys and network.
        acts: of the journey; each draws one event.
        words: each draws one utterance.
        is_stormy: acts may hit any node, and go on between utterances; the good flow is then not watched.
    """

    seed: int
    acts: tuple[int, ...]
    words: tuple[int, ...]
    is_stormy: bool = False


@dataclass
class Figures:
    """Counters of a trial; trials add up.

    Attributes:
        worst: highest ratio of the bytes one machine sent to an utterance's bytes, with both, by statement type
            and whether its sender was proven.
        said, drawn: bytes in all, by the same; for ``drawn`` those of the busiest machine each time.
        slowest: seconds of the slowest delivery, by statement type.
        spent: seconds in all, by statement type; ``count`` so many.
        tables: longest of each.
    """

    count: Counter[str] = field(default_factory=Counter)
    said: Counter[str] = field(default_factory=Counter)
    drawn: Counter[str] = field(default_factory=Counter)
    worst: dict[str, tuple[float, int, int]] = field(default_factory=dict)
    slowest: dict[str, float] = field(default_factory=dict)
    spent: Counter[str] = field(default_factory=Counter)
    tables: Counter[str] = field(default_factory=Counter)
    drops: Counter[str] = field(default_factory=Counter)

    def add(self, other: Figures) -> None:
        """Add the counters of another trial."""
        for mine, its in (
            (self.count, other.count), (self.said, other.said), (self.drawn, other.drawn), (self.spent, other.spent),
            (self.drops, other.drops),
        ):  # fmt: skip
            mine.update(its)
        self.tables |= other.tables
        for key, worst in other.worst.items():
            self.worst[key] = max(worst, self.worst.get(key, (0.0, 0, 0)))
        for key, slow_s in other.slowest.items():
            self.slowest[key] = max(slow_s, self.slowest.get(key, 0.0))


@dataclass(frozen=True, slots=True)
class _Said:
    """Utterance and its effect so far.

    Args:
        spent_s: time of its delivery.
        at_s: when it was sent.
    """

    utterance: Utterance
    echo: Echo
    spent_s: float
    at_s: float
    is_proven: bool


@contextmanager
def prepared() -> Iterator[None]:
    """Prepare a stage with the signing oracle and a tracing network."""
    with ExitStack() as stack:
        stack.enter_context(signing_oracle())
        stack.enter_context(mock.patch("lab.simulation.SimNetwork", TracingNetwork))
        yield


class Trial:
    """Runner of a plan; ``stage`` is made within ``prepared`` unless given (a settled one of the same seed)."""

    def __init__(self, plan: Plan, stage: Stage | None = None) -> None:
        self.plan = plan
        self.stage = stage or Stage(plan.seed)
        self.forge = Forge(self.stage, may_break=plan.is_stormy)
        self.figures = Figures()
        self.at: Utterance | str | None = None  # present activity
        self._sent = 0
        self._got: list[bytes] = []
        self._open: list[tuple[float, bytes]] = []  # messages of the good flow in flight, with their deadlines
        self._echoes: deque[_Said] = deque()

    def run(self) -> Figures:
        """Run the plan.

        Raises:
            BrokenError: an invariant does not hold.
            Exception: an error of ours that a machine did not contain.
        """
        for number in self.plan.acts:
            self._act(random.Random(number))
        for number, word in enumerate(self.plan.words):
            rng = random.Random(word)
            if self.plan.is_stormy and rng.random() < _ACT_CHANCE:
                self._act(rng)
            self._speak(rng)
            if number % _LOOK_EVERY == _LOOK_EVERY - 1:
                self._check_tables()
            if not self.plan.is_stormy and number % _GOOD_EVERY == _GOOD_EVERY - 1:
                self._send_good()
        self._check_tables()
        self._note_echoes(float("inf"))
        if self.plan.is_stormy:
            self._heal()
        else:
            self._settle_good()
        for machine in self.stage.machines().values():
            self.figures.drops.update({reason.label: count for reason, count in machine.drops().items()})
        return self.figures

    # -- hostile members

    def _speak(self, rng: random.Random) -> None:
        stage = self.stage
        utterance = self.forge.utter(rng)
        if utterance is None:
            return
        self.at = utterance
        echo, network, place = Echo(utterance.frames), stage.world.network, utterance.place
        assert isinstance(network, TracingNetwork)
        is_proven = stage.believes(utterance.persona, place)
        begun_s = time.perf_counter()  # a clock that costs little: the other ones are system calls
        network.echo = echo
        for frame in utterance.frames:
            network.inject(place.node, place.port, frame, place.mac)
        network.echo = None
        spent_s = time.perf_counter() - begun_s
        self._echoes.append(_Said(utterance, echo, spent_s, network.now.mono_s, is_proven=is_proven))
        if pause_s := rng.choice(_PAUSES_S):
            network.run(pause_s)
            self._note_echoes(network.now.mono_s - _ECHO_S)

    def _note_echoes(self, until_s: float) -> None:
        """Count the frames sent until then."""
        while self._echoes and self._echoes[0].at_s <= until_s:
            self._note(self._echoes.popleft())

    def _note(self, said: _Said) -> None:
        figures = self.figures
        what, size, drawn = said.utterance.what, said.utterance.size, said.echo.most
        key = what if said.is_proven else f"{what}, unproven"
        figures.count[what] += 1
        figures.said[key] += size
        figures.drawn[key] += drawn
        figures.worst[key] = max((drawn / size, drawn, size), figures.worst.get(key, (0.0, 0, 0)))
        figures.spent[what] += said.spent_s  # type: ignore[assignment]
        figures.slowest[what] = max(said.spent_s, figures.slowest.get(what, 0.0))
        if not said.is_proven and drawn > STRANGERS_MAX * size:
            raise BrokenError(f"{size} bytes of somebody unproven draw {drawn}: {what}")

    # -- invariants

    def _check_tables(self) -> None:
        for node, machine in self.stage.machines().items():
            found = sizes(machine)
            self.figures.tables |= found
            for table, size in found.items():
                if size > LIMITS.get(table, GENERAL_MAX):
                    raise BrokenError(f"{table} of {node} holds {size}")

    def _send_good(self) -> None:
        flow = self.stage.flow
        self._look_at_good()
        self._sent += 1
        message = b"good %d" % self._sent
        flow.publish(message)
        self._open.append((flow.world.network.now.mono_s + PROMISE_S, message))

    def _look_at_good(self) -> None:
        """Raise if the first message in flight is overdue."""
        flow = self.stage.flow
        flow.collect()
        got = [each.message for each in flow.got[GOOD[1]]]
        flow.got[GOOD[1]].clear()
        self._got += got
        here = set(self._got[-64:])
        self._open = [each for each in self._open if each[1] not in here]
        now_s = flow.world.network.now.mono_s
        if self._open and self._open[0][0] < now_s:
            raise BrokenError(f"{self._open[0][1]!r} of the good flow did not arrive within {PROMISE_S} s")

    def _settle_good(self) -> None:
        self._send_good()
        network = self.stage.world.network
        for _ in range(8):
            network.run(PROMISE_S / 4)
            self._look_at_good()

    def _heal(self) -> None:
        """Repair every link and let leases end, so that all timers that were armed fire."""
        world, network = self.stage.world, self.stage.world.network
        for sim_link in [*world.cables.values(), *world.leads.values()]:
            if not sim_link.is_up:
                network.set_link(sim_link, up=True)
        network.run(_HEALED_S)

    # -- the journey

    def _act(self, rng: random.Random) -> None:
        acts = _ACTS if self.plan.is_stormy else _CALM_ACTS
        act = rng.choice(acts)
        self.at = act.__name__
        act(self, rng)
        self.stage.world.network.run(rng.choice((0.0, 0.001, 0.1, 0.5, 2.0)))

    def _hostile_member(self, rng: random.Random) -> str:
        return rng.choice((*PARTS, "x1/mallory"))

    def _cut_sim_link(self, rng: random.Random) -> None:
        world = self.stage.world
        cables = list(world.cables.values()) + list(world.leads.values())
        world.network.set_link(rng.choice(cables), up=False)

    def _restore_sim_link(self, rng: random.Random) -> None:
        world = self.stage.world
        down = [each for each in [*world.cables.values(), *world.leads.values()] if not each.is_up]
        if down:
            world.network.set_link(rng.choice(down), up=True)

    def _cut_insider(self, rng: random.Random) -> None:
        world = self.stage.world
        sim_link = world.leads[self._hostile_member(rng)]
        world.network.set_link(sim_link, up=False)
        world.network.call(rng.choice((0.05, 1.0, 5.0)), lambda: world.network.set_link(sim_link, up=True))

    def _restart_insider(self, rng: random.Random) -> None:
        self.stage.world.restart_member(self._hostile_member(rng))

    def _restart_hostile_switch(self, rng: random.Random) -> None:
        self.stage.world.restart_switch(rng.choice(("evil", "far", "hired", "x1")))

    def _restart_hostile_rib(self, rng: random.Random) -> None:
        self.stage.world.restart_rib(rng.choice(("school#2", "cloud#2")))

    def _restart_any(self, rng: random.Random) -> None:
        world = self.stage.world
        if rng.random() < 0.5:
            world.restart_switch(rng.choice(list(world.switches)))
        else:
            world.restart_rib(rng.choice(list(world.ribs)))

    def _leave(self, rng: random.Random) -> None:
        label = self._hostile_member(rng)
        member = self.stage.world.members[label]
        for pending_advertisement in member.attachment.advertisements:
            member.unsubscribe(pending_advertisement.subject.name)
            member.withdraw(pending_advertisement.subject.name)
        self.stage.world.network.send_pending(label)

    def _join_in(self, rng: random.Random) -> None:
        """Restore the participation of a node that left."""
        self.stage.join_in()

    def _roam(self, rng: random.Random) -> None:
        self.stage.world.roam(rng.choice(("nuc1/insider", "nuc2/reader", "nuc4/alien")), rng.choice(("nuc2", "nuc3")))

    def _wait(self, rng: random.Random) -> None:
        self.stage.world.network.run(rng.choice((0.3, 1.0, 4.0, 9.0)))

    def _publish(self, rng: random.Random) -> None:
        self.stage.publish(rng.randbytes(rng.choice((0, 100, 3_000, 40_000))))

    def _resize(self, rng: random.Random) -> None:
        world = self.stage.world
        world.network.set_mtu(world.leads[self._hostile_member(rng)], rng.choice((576, 1_500, 9_000)))


_Act = Callable[[Trial, random.Random], None]
_CALM_ACTS: Final[tuple[_Act, ...]] = (
    Trial._cut_insider, Trial._restart_insider, Trial._restart_hostile_switch, Trial._restart_hostile_rib,
    Trial._leave, Trial._join_in, Trial._join_in, Trial._roam, Trial._wait, Trial._publish, Trial._resize,
)  # fmt: skip
_ACTS: Final[tuple[_Act, ...]] = (
    *_CALM_ACTS,
    Trial._cut_sim_link,
    Trial._restore_sim_link,
    Trial._restore_sim_link,
    Trial._restart_any,
)


def broken(plan: Plan, stage: Stage | None = None) -> Exception | None:
    """Run a plan; return the failure, or None. An error of the harness itself is no failure."""
    try:
        Trial(plan, stage).run()
    except LocalError as error:
        return None if "wants to be called" not in str(error) else error
    except Exception as error:
        return error
    return None


def shrunk(plan: Plan, fails: Callable[[Plan], bool], budget_s: float = 120.0) -> Plan:
    """Return a plan without the acts and words that the failure does not need (delta debugging)."""
    until_s = time.monotonic() + budget_s
    for part in ("words", "acts"):
        items: Sequence[int] = getattr(plan, part)
        size = max(len(items) // 2, 1)
        while items and time.monotonic() < until_s:
            at, has_changed = 0, False
            while at < len(items) and time.monotonic() < until_s:
                less = (*items[:at], *items[at + size :])
                smaller = replace(plan, words=less) if part == "words" else replace(plan, acts=less)
                if fails(smaller):
                    plan, items, has_changed = smaller, less, True
                else:
                    at += size
            if size == 1 and not has_changed:
                break
            size = max(size // 2, 1)
    return plan


__all__ += ["PERSONAS", "broken"]
