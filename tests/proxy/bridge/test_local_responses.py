"""Pace of responses. The queue of the simulated clients drops the oldest response, as that of ROS 2 does."""

from __future__ import annotations

from collections import deque

import pytest

from proxy.bridge.virtual_server import LocalResponses
from tests.proxy.endpoints.fake import FakeEndpoint, FakeGraph

QUEUE = 10  # rmw_qos_profile_services_default


class Clients(FakeEndpoint):
    """Endpoint whose client takes all its responses each ``takes_s`` seconds; ``now_s`` is set by the test."""

    def __init__(self, takes_s: float) -> None:
        super().__init__(FakeGraph(2, {}), "proxy")
        self.takes_s, self.now_s = takes_s, 0.0
        self.queue = deque[int]()
        self.took: list[int] = []
        self.passed_s: list[float] = []
        self.lost = 0
        self._takes_at_s = takes_s

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        del handle, raw
        if self.now_s >= self._takes_at_s:
            self.took += self.queue
            self.queue.clear()
            self._takes_at_s = self.now_s + self.takes_s
        self.queue.append(ticket)
        self.passed_s.append(self.now_s)
        if len(self.queue) > QUEUE:
            self.queue.popleft()
            self.lost += 1

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        self.answer(handle, ticket, reason.encode())


def pass_on(responses: LocalResponses, clients: Clients, now_s: float) -> None:
    """Run the timers until nothing waits."""
    clients.now_s = now_s
    responses.flush(now_s)
    while (due_s := responses.get_timer(clients.now_s)) is not None:
        assert due_s > clients.now_s
        clients.now_s = due_s
        responses.flush(due_s)


@pytest.mark.parametrize("takes_s", [0.001, 0.02])
def test_of_a_burst_of_responses_none_is_lost_and_the_order_stays(takes_s: float) -> None:
    clients = Clients(takes_s)
    responses = LocalResponses(clients, is_paced=True)
    for ticket in range(100):
        if ticket % 3:
            responses.answer(1, ticket, b"")
        else:
            responses.refuse(1, ticket, "no server")
    pass_on(responses, clients, 1.0)
    assert clients.lost == 0
    assert clients.took + list(clients.queue) == list(range(100))
    assert clients.passed_s[4] == 1.0, "a few go at once"
    assert clients.passed_s[-1] < 1.5


def test_without_pace_the_same_burst_is_lost() -> None:
    clients = Clients(0.02)
    responses = LocalResponses(clients, is_paced=False)
    for ticket in range(100):
        responses.answer(1, ticket, b"")
    responses.flush(0.0)
    assert clients.lost == 100 - QUEUE


def test_clients_that_ask_often_wait_for_nothing() -> None:
    clients, late = Clients(0.0), 0.0
    responses = LocalResponses(clients, is_paced=True)
    for at in range(6_000):  # 2,000 a second
        now_s = at / 2_000
        responses.handle_request(now_s)
        responses.answer(1, at, b"")
        clients.now_s = now_s
        responses.flush(now_s)
        if now_s >= 2.0:
            late = max(late, (at - clients.queue[-1]) / 2_000)
    assert late < 0.001


def test_what_waits_when_the_server_ends_is_passed_on() -> None:
    clients = Clients(0.0)
    responses = LocalResponses(clients, is_paced=True)
    for ticket in range(20):
        responses.answer(1, ticket, b"")
    responses.flush_all()
    assert len(clients.passed_s) == 20
    assert responses.get_timer(0.0) is None
