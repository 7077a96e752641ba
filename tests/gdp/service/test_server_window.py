"""Window of a local server. The queue of the simulated servers drops the oldest request, as that of ROS 2 does."""

from __future__ import annotations

import heapq
from collections import deque

import pytest

from gdp.names import Name
from gdp.service.server_window import ServerWindow
from gdp.service.serving import Asked, Serving

CLIENT = Name(bytes(32))
QUEUE = 10  # rmw_qos_profile_services_default
SIZE = 8


class SimulatedServer:
    """Server with a queue of ten; ``workers`` requests are processed at a time, each for ``takes_s``.

    Attributes:
        lost: requests that its queue dropped.
    """

    def __init__(self, takes_s: float, workers: int = 1, frozen_s: float = 0.0) -> None:
        self._takes_s = takes_s
        self._free = workers
        self._frozen_until_s = frozen_s
        self._queue = deque[int]()
        self._ends: list[tuple[float, int]] = []
        self.lost: list[int] = []

    def ask(self, number: int, now_s: float) -> None:
        self._queue.append(number)
        self._start(now_s)
        if len(self._queue) > QUEUE:
            self.lost.append(self._queue.popleft())

    def next_s(self) -> float | None:
        if self._ends:
            return self._ends[0][0]
        return self._frozen_until_s if self._queue else None

    def poll(self, now_s: float) -> list[int]:
        self._start(now_s)
        done = []
        while self._ends and self._ends[0][0] <= now_s:
            done.append(heapq.heappop(self._ends)[1])
            self._free += 1
            self._start(now_s)
        return done

    def _start(self, now_s: float) -> None:
        while self._queue and self._free and now_s >= self._frozen_until_s:
            self._free -= 1
            heapq.heappush(self._ends, (now_s + self._takes_s, self._queue.popleft()))


def run(serving: Serving[bytes], server: SimulatedServer, calls_s: list[float]) -> list[float]:
    """Make calls at these seconds; return how long each took that was answered."""
    took, begun, now_s, calls = list[float](), dict[int, float](), 0.0, deque(calls_s)
    while calls or begun.keys() - set(server.lost):
        times = [calls[0] if calls else None, server.next_s(), serving.get_timer()]
        now_s = max(now_s, min(each for each in times if each is not None))
        while calls and calls[0] <= now_s:
            begun[serving.begin(now_s, None, Asked(CLIENT, 0, len(calls)), b"")] = calls.popleft()
        for number in server.poll(now_s):
            serving.end(number)
            took.append(now_s - begun.pop(number))
        for turn in serving.poll_turns(now_s):
            server.ask(turn.number, now_s)
    return took


def windowed() -> Serving[bytes]:
    return Serving(0, window=ServerWindow(SIZE))


@pytest.mark.parametrize(("takes_s", "count"), [(0.0005, 3_000), (0.005, 30), (0.005, 300), (0.05, 30)])
def test_a_burst_loses_nothing_in_the_queue_of_a_server_that_works_on_one_at_a_time(takes_s: float, count: int) -> None:
    server = SimulatedServer(takes_s)
    took = run(windowed(), server, [0.0] * count)
    assert (server.lost, len(took)) == ([], count)
    assert max(took) == pytest.approx(count * takes_s)


def test_without_a_window_the_same_burst_is_lost() -> None:
    server = SimulatedServer(0.005)
    assert len(run(Serving(0), server, [0.0] * 30)) == QUEUE + 1
    assert len(server.lost) == 30 - QUEUE - 1


@pytest.mark.parametrize("frozen_s", [0.3, 0.6, 0.9])
def test_a_server_that_was_frozen_gets_every_request(frozen_s: float) -> None:
    server = SimulatedServer(0.001, frozen_s=frozen_s)
    took = run(windowed(), server, [0.02 * at for at in range(150)])
    assert (server.lost, len(took)) == ([], 150)
    assert max(took) < frozen_s + 0.2


@pytest.mark.parametrize("takes_s", [0.05, 0.1, 0.3, 1.0, 2.0])
def test_a_server_that_works_on_many_at_a_time_soon_gets_all(takes_s: float) -> None:
    server = SimulatedServer(takes_s, workers=1_000)
    took = run(windowed(), server, [at / 200 for at in range(2_000)])
    assert (server.lost, len(took)) == ([], 2_000)
    assert max(took) < takes_s + 4.0
    assert max(took[-1_000:]) < takes_s * 1.5, "the window has grown to what the server works on"


def test_five_hundred_at_once_reach_a_server_that_answers_none_before_it_has_all() -> None:
    serving = windowed()
    for call in range(500):
        serving.begin(0.0, None, Asked(CLIENT, 0, call), b"")
    now_s, given = 0.0, len(serving.poll_turns(0.0))
    assert given == SIZE
    while given < 500:
        now_s = serving.get_timer() or 10.0
        given += len(serving.poll_turns(now_s))
    assert now_s <= 5.0


def test_requests_that_were_overtaken_leave_their_place() -> None:
    serving = windowed()
    numbers = [serving.begin(0.0, None, Asked(CLIENT, 0, call), b"") for call in range(20)]
    serving.poll_turns(0.0)
    serving.end(numbers[SIZE - 1])
    assert len(serving.poll_turns(0.1)) == SIZE
    for number in numbers[: SIZE - 1]:
        assert serving.end(number) is not None, "a late answer counts all the same"
    assert not serving.poll_turns(0.2)


def test_a_call_whose_time_is_over_leaves_its_place() -> None:
    serving = windowed()
    for call in range(SIZE + 1):
        serving.begin(0.0, 0.3, Asked(CLIENT, 0, call), b"")
    assert len(serving.poll_turns(0.0)) == SIZE
    serving.begin(0.2, 0.3, Asked(CLIENT, 0, SIZE + 1), b"")
    assert len(serving.expired(0.3)) == SIZE + 1
    assert len(serving.poll_turns(0.3)) == 1


def test_a_stopped_request_keeps_its_place_in_the_queue() -> None:
    serving = windowed()
    numbers = [serving.begin(0.0, None, Asked(CLIENT, 0, call), b"") for call in range(SIZE + 2)]
    serving.poll_turns(0.0)
    assert serving.stop(Asked(CLIENT, 0, 0)) == numbers[0]
    assert serving.stop(Asked(CLIENT, 0, SIZE)) is None
    assert not serving.poll_turns(0.0)
    assert serving.end(numbers[0]) is None
    assert [turn.number for turn in serving.poll_turns(0.1)] == [numbers[SIZE + 1]]


def test_after_the_end_of_all_calls_the_window_is_empty() -> None:
    serving = windowed()
    for call in range(SIZE + 1):
        serving.begin(0.0, None, Asked(CLIENT, 0, call), b"")
    serving.poll_turns(0.0)
    assert len(serving.fail_all()) == SIZE + 1
    assert serving.get_timer() is None
    for call in range(SIZE + 1):
        serving.begin(1.0, None, Asked(CLIENT, 0, call), b"")
    assert len(serving.poll_turns(1.0)) == SIZE
