"""Nearest server: rank by path cost, and silence while a response is owed."""

from __future__ import annotations

from dataclasses import dataclass, field

from gdp.intervals import LOOK_S, OWING
from gdp.limits import COST_UNREACHABLE
from gdp.names import Name
from gdp.service.dispatch import Ask, Dispatch, Effect, Probe
from gdp.service.nearest import ServerPath
from gdp.service.replication import Mode, Replication

FAR, NEAR, NEXT = (Name(bytes([number]) * 32) for number in (1, 2, 3))


@dataclass
class Paths:
    costs: dict[Name, int] = field(default_factory=lambda: {FAR: 180, NEAR: 20, NEXT: 60})
    heard: dict[Name, float] = field(default_factory=dict)
    trip_s: float = 0.01
    deaf_s: float = 0.0

    def path(self, server: Name) -> ServerPath:
        return ServerPath(self.costs[server], self.trip_s, self.heard.get(server, 0.0), self.deaf_s)


class Bench:
    def __init__(self) -> None:
        self.paths = Paths()
        self.dispatch = Dispatch[str](Replication(Mode.NEAREST), start=0, paths=self.paths)
        self.answers: list[str] = []
        self.now_s = 100.0
        for server in (FAR, NEAR, NEXT):
            self.paths.heard[server] = self.now_s
            self.dispatch.replica_joined(server, self.now_s)

    def begin(self, first: tuple[Name, ...] = ()) -> int:
        return self.dispatch.begin(self.now_s, lambda _: b"?", None, self.answers.append, lambda *_: None, first)

    def asked(self) -> list[Name]:
        return [
            each for effect in self.dispatch.poll_effects() if isinstance(effect, Ask) for each in effect.servers or ()
        ]

    def run(self, duration_s: float, heard: tuple[Name, ...] = ()) -> list[Effect]:
        """Let time pass, while some servers report; return what is sent."""
        end_s, effects = self.now_s + duration_s, list[Effect]()
        while (due_s := self.dispatch.get_timer()) is not None and due_s <= end_s:
            self.now_s = due_s
            self.paths.heard |= dict.fromkeys(heard, due_s)
            self.dispatch.handle_timer(due_s)
            effects += self.dispatch.poll_effects()
        self.now_s = end_s
        return effects


def test_the_server_of_the_least_cost_is_asked_whatever_the_order_of_names() -> None:
    bench = Bench()
    bench.begin()
    assert bench.asked() == [NEAR]
    bench.paths.costs[NEAR] = COST_UNREACHABLE
    bench.begin()
    assert bench.asked() == [NEXT]
    bench.dispatch.replica_leaving(NEXT)
    bench.begin()
    assert bench.asked() == [FAR]


def test_a_server_that_owes_a_response_is_probed_and_stays_the_only_one_while_it_reports() -> None:
    bench = Bench()
    call = bench.begin()
    assert bench.asked() == [NEAR]
    effects = bench.run(30.0, heard=(NEAR,))
    assert set(effects) == {Probe(NEAR)}
    assert abs(len(effects) - 30.0 / OWING.refresh_s) <= 1
    bench.dispatch.answered(call, NEAR, "done", bench.now_s)
    assert not [each for each in bench.run(1.0) if isinstance(each, Probe)]
    assert bench.answers == ["done"]


def test_the_next_nearest_is_asked_once_when_the_nearest_falls_silent_and_later_calls_ask_it_first() -> None:
    bench = Bench()
    call = bench.begin()
    bench.run(1.0, heard=(NEAR,))
    asks = [each for each in bench.run(OWING.lease_s + 0.001, heard=(NEXT,)) if isinstance(each, Ask)]
    assert asks == [Ask(call, b"?", (NEXT,))]
    assert not [each for each in bench.run(3.0, heard=(NEXT,)) if isinstance(each, Ask)]
    bench.begin()
    assert bench.asked() == [NEXT]
    bench.paths.heard[NEAR] = bench.now_s  # it is back
    bench.begin()
    assert bench.asked() == [NEAR]


def test_no_third_server_is_asked_when_a_silent_one_is_lost_while_the_next_one_works() -> None:
    bench = Bench()
    bench.begin()
    bench.run(1.0, heard=(NEXT,))
    bench.dispatch.replica_lost(NEAR, bench.now_s, "gone")
    assert bench.asked() == []
    asks = [each.servers for each in bench.run(1.0, heard=(FAR,)) if isinstance(each, Ask)]
    assert asks == [(FAR,)]  # the next one is silent, too


def test_a_program_that_did_not_run_takes_no_server_for_dead() -> None:
    bench = Bench()
    bench.begin()
    bench.asked()
    bench.now_s += 5.0 + 2 * LOOK_S
    bench.dispatch.handle_timer(bench.now_s)
    assert bench.asked() == []
    assert [each for each in bench.run(3 * OWING.lease_s, heard=(NEXT,)) if isinstance(each, Ask)]


def test_silence_without_a_switch_and_before_a_round_trip_is_no_sign() -> None:
    bench = Bench()
    bench.paths.trip_s = 0.4
    bench.begin()
    bench.asked()
    assert not [each for each in bench.run(0.5, heard=(NEXT,)) if isinstance(each, Ask)]
    bench.paths.deaf_s = bench.now_s
    assert not [each for each in bench.run(0.5, heard=(NEXT,)) if isinstance(each, Ask)]
    assert [each for each in bench.run(0.1, heard=(NEXT,)) if isinstance(each, Ask)]


def test_a_result_that_one_server_has_moves_only_when_that_is_lost() -> None:
    bench = Bench()
    bench.begin(first=(FAR,))
    assert bench.asked() == [FAR]
    assert bench.run(10.0) == []
    bench.dispatch.replica_lost(FAR, bench.now_s, "gone")
    assert bench.asked() == [NEAR]
