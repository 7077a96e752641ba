"""Servers and clients that misbehave within their rights, or die at a bad moment, as the bridge meets them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.proxy.bridge.sites import Sites
from tests.proxy.bridge.test_actions import goal
from tests.proxy.bridge.test_replicas import actions


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def test_a_goal_whose_servers_all_die_in_one_moment_fails_and_breaks_nothing(sites: Sites) -> None:
    _, servers, client, caller = actions(sites, mode="mode: some, copies: 1")
    for server in servers:
        server.goals.answer = None
    caller.goals.call(goal(1, 10))
    sites.run(0.1)
    with pytest.MonkeyPatch.context() as patch:
        for who in ("peers", "heard"):
            patch.setattr(client.member, who, lambda _: [])
        assert sites.run(2, lambda: len(caller.goals.outcomes) == 1)
    sites.run(1)
    assert client.bridge.flows
