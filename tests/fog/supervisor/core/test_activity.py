"""Idle detection of a cluster by its requests."""

from __future__ import annotations

from fog.supervisor.core.activity import Activity


def test_a_cluster_is_idle_since_its_last_request() -> None:
    activity = Activity(100.0)
    assert activity.idle_s({"m1": 0}, 110.0) == 10.0
    assert activity.idle_s({"m1": 3}, 120.0) == 0.0
    assert activity.idle_s({"m1": 3, "m2": 0}, 150.0) == 30.0


def test_a_machine_that_cannot_be_asked_counts_as_used() -> None:
    assert Activity(0.0).idle_s({"m1": None}, 500.0) == 0.0
