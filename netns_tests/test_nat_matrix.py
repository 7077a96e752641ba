"""Switches behind NATs: each pair reaches each other through one border, and directly where a direct path exists.

All switches belong to one domain with one border. For each pair, a node at the first switch calls a service at the
second. At last all programs of the border are killed: the direct pairs go on, and once it is back, all do.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from itertools import product

import pytest

import gdp
from gdp.trust.right import Right
from lab.internet.access import Access, allows_direct
from lab.internet.host import Host
from lab.internet.laboratory import Laboratory
from lab.internet.overlay import Overlay
from lab.process import until

pytestmark = [pytest.mark.netns, pytest.mark.nightly]

PATIENCE_S = 180.0
CALL_S = 15.0  # a busy machine answers late
LOOK_S = 0.25
OUTAGE_S = 10.0  # longer than the leases of names, neighbours, trees and readers
LEASE_S = 2.0
KINDS = list(Access)
# The lines of the Fano plane: each pair of the seven kinds is in one group of three. Two small laboratories cost a
# machine less than one of twice the size, where each switch has a tunnel to each other.
GROUPS = [
    tuple(KINDS[at] for at in line)
    for line in ((0, 1, 2), (0, 3, 4), (0, 5, 6), (1, 3, 5), (1, 4, 6), (2, 3, 6), (2, 4, 5))
]
Pair = tuple[Access, Access]


def test_each_pair_of_kinds_is_in_a_group() -> None:
    assert {pair for group in GROUPS for pair in product(group, group)} == set(product(KINDS, KINDS))


@pytest.mark.parametrize("kinds", GROUPS, ids=lambda kinds: ", ".join(each.value for each in kinds))
def test_switches_behind_nats_reach_each_other_and_directly_where_that_is_possible(
    kinds: Sequence[Access], laboratory: Laboratory
) -> None:
    if shutil.which("wireguard-go") is None or not os.access("/dev/net/tun", os.R_OK | os.W_OK):
        pytest.skip("needs wireguard-go and /dev/net/tun")
    pairs = list(product(kinds, kinds))
    possible = {pair for pair in pairs if allows_direct(*pair)}
    border = laboratory.add_host("border", laboratory.add_site("dc", Access.PUBLIC))
    callers, servers = ([add(laboratory, access, side) for access in kinds] for side in "ab")
    overlay = Overlay(laboratory, border)
    with ExitStack() as stack:
        overlay.stand_up(*callers, *servers)
        services = {host.label: f"reach-{host.label}" for host in servers}
        calls = {service: [Right.CALL] for service in services.values()}
        overlay.grant({host.label: calls for host in callers})
        overlay.grant({label: {name: [Right.SERVE]} for label, name in services.items()})
        everyone = [*callers, *servers]
        with ThreadPoolExecutor(len(everyone)) as pool:
            opened = pool.map(partial(overlay.open_session, lease_s=LEASE_S), everyone)
            sessions = [stack.enter_context(session) for session in opened]
        for session, name in zip(sessions[len(kinds) :], services.values(), strict=True):
            session.serve(name, lambda request: request.payload)
        calling = dict(zip(pairs, product(sessions[: len(kinds)], services.values()), strict=True))
        for session in sessions[: len(kinds)]:
            call_each(session, services.values())

        def direct() -> set[Pair]:
            links = {one: {each.peer for each in overlay.links(one) if each.is_direct} for one in callers}
            ends = zip(pairs, product(callers, servers), strict=True)
            return {pair for pair, (one, other) in ends if other.label in links[one]}

        until(lambda: direct() >= possible, lambda: f"direct tunnels of {possible - direct()}", PATIENCE_S)
        assert direct() == possible
        for session in sessions[: len(kinds)]:  # over the direct tunnels, where there are some
            call_each(session, services.values())
        overlay.kill(border)
        with ThreadPoolExecutor(len(pairs)) as pool:
            outlived = pool.map(goes_on, [calling[pair] for pair in possible])
            assert dict(zip(possible, outlived, strict=True)) == dict.fromkeys(possible, True)
        overlay.start(border)
        for session in sessions[: len(kinds)]:
            call_each(session, services.values())


def add(laboratory: Laboratory, access: Access, side: str) -> Host:
    """Return a host behind a kind of access."""
    label = side + "".join(word[0] for word in access.value.lower().split())
    return laboratory.add_host(label, laboratory.add_site(f"of-{label}", access))


def call_each(client: gdp.Session, services: Iterable[str]) -> None:
    """Call each service until it answers."""
    for service in services:
        until(partial(answers, client, service), f"an answer of {service}", PATIENCE_S)


def answers(client: gdp.Session, service: str) -> bool:
    """Return whether a call is answered."""
    try:
        client.call(service, b"?", timeout_s=CALL_S)
    except gdp.SessionError:
        return False
    return True


def goes_on(pair: tuple[gdp.Session, str]) -> bool:
    """Return whether each call during the outage is answered."""
    end_s = time.monotonic() + OUTAGE_S
    while time.monotonic() < end_s:
        if not answers(*pair):
            return False
        time.sleep(LOOK_S)
    return True
