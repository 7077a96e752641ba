"""Queue of messages whose senders are not described yet: bounded, with a quota for each client."""

from __future__ import annotations

from gdp.client.delivery import Delivered
from gdp.client.participant import Message
from gdp.names import Name
from proxy.bridge.remote_clients import EARLY_MAX, UndescribedRequests

A, B, C = (bytes([number]) * 32 for number in (1, 2, 3))


def message(client: bytes, size: int, number: int = 0) -> Message:
    return Message(Name(bytes(32)), Delivered(client, 0, number, bytes(size), 1, 0), b"")


def test_a_clients_messages_wait_in_their_order_and_are_taken_once() -> None:
    early = UndescribedRequests()
    for number in range(3):
        assert early.add(message(A, 1, number))
    assert early.add(message(B, 1))
    assert [each.delivered.number for each in early.poll_messages(A)] == [0, 1, 2]
    assert (early.poll_messages(A), len(early)) == ([], 1)


def test_a_client_leaves_capacity_for_the_next() -> None:
    early = UndescribedRequests(max_bytes=80)
    assert [early.add(message(A, 40)), early.add(message(A, 1)), early.add(message(B, 20))] == [True, False, True]
    early.poll_messages(A)
    assert early.add(message(C, 40))


def test_a_client_has_so_many_at_most() -> None:
    early = UndescribedRequests()
    added = [early.add(message(A, 0)) for _ in range(EARLY_MAX + 1)]
    assert (sum(added), early.add(message(B, 0))) == (EARLY_MAX, True)


def test_waiting_requests_of_clients_that_are_gone_are_counted_and_their_space_is_free() -> None:
    early = UndescribedRequests(max_bytes=80)
    early.add(message(A, 40))
    early.add(message(B, 20))
    assert (early.forget_all_but({B}), len(early), early.add(message(C, 50))) == (1, 1, True)
