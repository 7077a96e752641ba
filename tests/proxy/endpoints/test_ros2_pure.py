"""Sans-I/O parts of the ros2 endpoint: profiles, QoS checks, and recognition of own messages."""

from __future__ import annotations

import time
import warnings
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from proxy.endpoints.core.endpoint import GraphEntity, Role
from proxy.endpoints.ros2.entities import ServiceEntity
from proxy.endpoints.ros2.loopback_filter import LoopbackFilter
from proxy.endpoints.ros2.qos import conflict, filled, incompatibility
from proxy.endpoints.ros2.session import ServiceType
from proxy.serial.channel import Channel, Qos

RELIABLE = filled(None)
STRING = Channel("/a", "std_msgs/msg/String", 2, hash="RIHS01_" + "a" * 64)


@pytest.mark.parametrize(
    ("offered", "requested", "policy"),
    [
        (RELIABLE, RELIABLE, ""),
        (RELIABLE, replace(RELIABLE, reliability="best_effort"), ""),
        (replace(RELIABLE, reliability="best_effort"), RELIABLE, "reliability"),
        (RELIABLE, replace(RELIABLE, durability="transient_local"), "durability"),
        (replace(RELIABLE, durability="transient_local"), RELIABLE, ""),
        (RELIABLE, replace(RELIABLE, deadline=(1, 0)), "deadline"),
        (replace(RELIABLE, deadline=(1, 0)), replace(RELIABLE, deadline=(2, 0)), ""),
        (replace(RELIABLE, deadline=(2, 0)), replace(RELIABLE, deadline=(1, 0)), "deadline"),
        (RELIABLE, replace(RELIABLE, liveliness="manual_by_topic"), "liveliness"),
        (replace(RELIABLE, liveliness="manual_by_topic"), RELIABLE, ""),
        (replace(RELIABLE, lease=(3, 0)), replace(RELIABLE, lease=(2, 0)), "liveliness"),
        (replace(RELIABLE, reliability="unknown"), RELIABLE, ""),
    ],
)
def test_an_offer_that_does_not_meet_the_request_names_its_policy(offered: Qos, requested: Qos, policy: str) -> None:
    assert conflict(offered, requested).partition(":")[0] == policy


def test_unknown_words_and_no_depth_become_the_defaults() -> None:
    unknown = Qos(
        history="unknown",
        depth=0,
        reliability="unknown",
        durability="unknown",
        deadline=(0, 0),
        lifespan=(0, 0),
        liveliness="unknown",
        lease=(0, 0),
    )
    assert filled(unknown) == RELIABLE


def test_keep_all_becomes_a_long_but_finite_queue() -> None:
    assert filled(replace(RELIABLE, history="keep_all")) == replace(RELIABLE, depth=1_000)


@pytest.mark.parametrize("infinite", [(2_147_483_647, 4_294_967_295), (9_223_372_036, 854_775_807)])
def test_every_way_to_say_infinite_is_left_unsaid(infinite: tuple[int, int]) -> None:
    assert filled(replace(RELIABLE, deadline=infinite, lifespan=infinite, lease=infinite)) == RELIABLE


def test_a_qos_report_names_the_node_and_the_difference() -> None:
    end = GraphEntity(Role.PUBLISHES, "/a", "std_msgs/msg/String", "/talker", "01", hash=STRING.hash, qos=RELIABLE)
    assert incompatibility(Role.SUBSCRIBES, STRING, RELIABLE, frozenset({end})) == ""
    other = replace(end, hash="RIHS01_" + "b" * 64)
    assert "another definition of std_msgs/msg/String" in incompatibility(
        Role.SUBSCRIBES, STRING, RELIABLE, frozenset({end, other})
    )
    typed = replace(end, type_name="std_msgs/msg/Bool")
    assert "/talker publishes it with another type" in incompatibility(
        Role.SUBSCRIBES, STRING, RELIABLE, frozenset({typed})
    )
    assert incompatibility(Role.PUBLISHES, STRING, RELIABLE, frozenset({typed})) == ""  # it publishes too


def test_as_many_copies_are_taken_out_as_were_published() -> None:
    own = LoopbackFilter()
    own.add(b"\0\1\0\0same", 0.0)
    own.add(b"\0\1\0\0same", 0.1)
    assert own.is_loopback(b"\0\1\0\3same", 0.2)  # the encapsulation may state how much padding there is
    assert not own.is_loopback(b"\0\1\0\0other", 0.2)
    assert own.is_loopback(b"\0\1\0\0same", 0.3)
    assert not own.is_loopback(b"\0\1\0\0same", 0.3)


def test_what_was_not_heard_soon_is_forgotten() -> None:
    own = LoopbackFilter()
    own.add(b"\0\1\0\0a", 0.0)
    own.is_loopback(b"\0\1\0\0a", 0.1)
    own.add(b"\0\1\0\0a", 1.0)
    assert own.is_loopback(b"\0\1\0\0a", 2.5)  # the first copy's time is over, not the second's
    own.add(b"\0\1\0\0a", 3.0)
    assert not own.is_loopback(b"\0\1\0\0a", 5.1)


def test_memory_is_bounded() -> None:
    own = LoopbackFilter()
    for number in range(10_000):
        own.add(b"\0\1\0\0%d" % number, 0.0)
    assert not own.is_loopback(b"\0\1\0\0" + b"1", 0.1)
    assert own.is_loopback(b"\0\1\0\0" + b"9999", 0.1)


class UnmatchedService:
    """Server's handle of rcl whose client does not match yet for some sends."""

    def __init__(self, unmatched: int) -> None:
        self.unmatched = unmatched
        self.sent = list[object]()

    def service_send_response(self, response: object, request: object) -> None:
        """Send a response, or warn as rclpy does when rmw gives up."""
        del request
        self.unmatched -= 1
        if self.unmatched >= 0:
            warnings.warn("failed to send response (timeout)", RuntimeWarning, stacklevel=2)
        else:
            self.sent.append(response)


@pytest.mark.parametrize(("unmatched", "later_s", "sent"), [(1, 0.5, ["yes"]), (2, 0.5, []), (1, 2.0, [])])
def test_a_response_is_sent_again_until_its_client_matches(unmatched: int, later_s: float, sent: list[str]) -> None:
    handle = UnmatchedService(unmatched)
    entity = ServiceEntity(1, cast("ServiceType", SimpleNamespace(Request=str, Response=str)), handle)  # type: ignore[arg-type]
    entity._tickets[7] = SimpleNamespace(sequence_number=1)
    entity.send(7, "yes")
    assert handle.sent == []
    entity.tend(time.monotonic() + later_s)
    assert handle.sent == sent
