"""Matrix of NATs: switches behind each kind of access, which of them reach each other, and which without the border.

I/O. All switches belong to one domain with one border. For each pair, a node at the first switch calls a service at
the second. The switch's status then says whether a direct tunnel is up. At last all programs of the border are killed:
the direct pairs go on, and once it is back, all do.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from itertools import combinations, product
from typing import Final, NamedTuple

import gdp
from gdp.trust.right import Right
from internet.access import Access, allows_direct
from internet.host import Host
from internet.laboratory import Laboratory
from internet.overlay import Overlay

_LOOK_S: Final = 0.25
_GROUP: Final = 3
_CALL_S: Final = 5.0
_OUTAGE_S: Final = 10.0  # longer than the leases of names, neighbours, trees and readers
_LEASE_S: Final = 2.0
_SIDES: Final = ("a", "b")
Pair = tuple[Access, Access]


class Outcome(NamedTuple):
    """What a pair came to.

    Attributes:
        reached_s: when the first call was answered, in seconds since all switches were up; None: never.
        direct_s: when the direct tunnel was seen up at the first switch; None: never.
        outlived: whether every call was answered while the border was dead; tried with a direct tunnel only.
        back_s: when a call was answered again, in seconds since the border was started again; None: never.
    """

    reached_s: float | None
    direct_s: float | None
    outlived: bool
    back_s: float | None

    def is_as_expected(self, pair: Pair) -> bool:
        """Return whether the pair is connected, and directly, also without the border, where that is possible."""
        is_direct = allows_direct(*pair)
        is_connected = self.reached_s is not None and self.back_s is not None
        return is_connected and (self.direct_s is not None) is self.outlived is is_direct


def measure(laboratory: Laboratory, kinds: Iterable[Access], *, timeout_s: float = 60.0) -> dict[Pair, Outcome]:
    """Return the outcome of each ordered pair of these kinds.

    ``timeout_s``: longest wait for calls and for the direct tunnels that are possible, once every node is attached.
    Raises ``LocalError``: a switch does not start, for example because there is no WireGuard.
    """
    chosen = list(kinds)
    pairs = list(product(chosen, chosen))
    border = laboratory.add_host("border", laboratory.add_site("dc", Access.PUBLIC))
    hosts = {side: [_add(laboratory, access, side) for access in chosen] for side in _SIDES}
    everyone = [*hosts["a"], *hosts["b"]]
    overlay = Overlay(laboratory, border)
    with ExitStack() as stack:
        overlay.stand_up(*everyone)
        begun_s = time.monotonic()
        services = {host.label: f"reach-{host.label}" for host in hosts["b"]}
        calls = {service: [Right.CALL] for service in services.values()}
        overlay.grant({host.label: calls for host in hosts["a"]})
        overlay.grant({label: {name: [Right.SERVE]} for label, name in services.items()})
        with ThreadPoolExecutor(len(everyone)) as pool:
            opened = pool.map(partial(overlay.open_session, lease_s=_LEASE_S), everyone)
            sessions = [stack.enter_context(session) for session in opened]
            for session, host in zip(sessions[len(chosen) :], hosts["b"], strict=True):
                session.serve(services[host.label], lambda request: request.payload)
        deadline_s = time.monotonic() + timeout_s
        reached = _call_all(sessions[: len(chosen)], list(services.values()), begun_s, deadline_s)
        direct = _wait_for_direct(overlay, hosts, pairs, begun_s, deadline_s)
        overlay.kill(border)
        outlived = _outlive(list(product(sessions[: len(chosen)], services.values())), direct)
        overlay.start(border)
        begun_s = time.monotonic()
        back = _call_all(sessions[: len(chosen)], list(services.values()), begun_s, begun_s + timeout_s)
    return {pair: Outcome(reached[at], direct.get(at), at in outlived, back[at]) for at, pair in enumerate(pairs)}


def batches(kinds: Iterable[Access]) -> list[tuple[Access, ...]]:
    """Return groups of at most three kinds, such that each pair of kinds is in one: seven groups for seven kinds.

    Two small laboratories cost a machine less than one of twice the size, where each switch has a tunnel to each other.
    """
    groups: list[tuple[Access, ...]] = [*combinations(kinds, _GROUP)] or [tuple(kinds)]
    left = {pair for group in groups for pair in combinations(group, 2)}
    chosen: list[tuple[Access, ...]] = []
    while left or not chosen:
        chosen.append(max(groups, key=lambda group: len(left & set(combinations(group, 2)))))
        left -= set(combinations(chosen[-1], 2))
    return chosen


def _add(laboratory: Laboratory, access: Access, side: str) -> Host:
    label = side + "".join(word[0] for word in access.value.lower().split())
    return laboratory.add_host(label, laboratory.add_site(f"of-{label}", access))


def _call_all(
    clients: Sequence[gdp.Session], services: Sequence[str], begun_s: float, deadline_s: float
) -> list[float | None]:
    """Call each service from each client until it answers, the clients at once; return the times."""

    def call_each(client: gdp.Session) -> list[float | None]:
        return [_answered_s(client, service, begun_s, deadline_s) for service in services]

    with ThreadPoolExecutor(len(clients)) as pool:
        return [each for found in pool.map(call_each, clients) for each in found]


def _answered_s(client: gdp.Session, service: str, begun_s: float, deadline_s: float) -> float | None:
    while time.monotonic() < deadline_s:
        try:
            client.call(service, b"?", timeout_s=_CALL_S)
        except gdp.SessionError:  # no path to it yet
            continue
        return time.monotonic() - begun_s
    return None


def _outlive(pairs: Sequence[tuple[gdp.Session, str]], direct: Iterable[int]) -> set[int]:
    """Call over the direct pairs, given by number, during the outage; return those with every call answered."""
    end_s = time.monotonic() + _OUTAGE_S

    def goes_on(at: int) -> bool:
        client, service = pairs[at]
        while time.monotonic() < end_s:
            try:
                client.call(service, b"?", timeout_s=_CALL_S)
            except gdp.SessionError:
                return False
            time.sleep(_LOOK_S)
        return True

    numbers = list(direct)
    with ThreadPoolExecutor(max(len(numbers), 1)) as pool:
        return {at for at, is_alive in zip(numbers, pool.map(goes_on, numbers), strict=True) if is_alive}


def _wait_for_direct(
    overlay: Overlay, hosts: Mapping[str, Sequence[Host]], pairs: Sequence[Pair], begun_s: float, deadline_s: float
) -> dict[int, float]:
    """Return by number of the pair when a direct tunnel was up; wait for those that are possible."""
    ends = list(product(hosts["a"], hosts["b"]))
    expected = {at for at, pair in enumerate(pairs) if allows_direct(*pair)}
    found: dict[int, float] = {}
    while True:
        tunnels = {host.label: overlay.tunnels(host) for host in hosts["a"]}
        now_s = time.monotonic() - begun_s
        for at, (one, other) in enumerate(ends):
            row = tunnels[one.label].get(other.label, {})
            if row.get("direct") and row.get("up"):
                found.setdefault(at, now_s)
        if expected <= found.keys() or time.monotonic() > deadline_s:
            return found
        time.sleep(_LOOK_S)
