"""Lookup of a name for the control command ``lookup``: who advertises it, as a RIB states it to this node.

Sans-I/O. A switch asks its RIB, as it does for a frame to an unknown name; the query is bounded and repeated like any
other. The client asks the switch again until the state is no longer ``asked``. A RIB answers from its store at once.

| state | what it means |
|---|---|
| ``asked`` | the query is under way |
| ``answered`` | the RIB has answered |
| ``no-answer`` | no RIB has answered in time |
| ``no-rib`` | the switch knows of no RIB; advertisers are those that it knew before |
| ``stored`` | this node is the RIB |
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from gdp.errors import LocalError, StatementError
from gdp.intervals import IDLE_S
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.trust.advertisement import Advertisement

if TYPE_CHECKING:  # a node loads its own core alone
    from gdp.rib.core import RibCore
    from gdp.switch.core import SwitchCore

ADVERTISERS_MAX: Final = 64  # in one answer
_SETTLE_S: Final = 0.2  # further advertisers may follow the first response
_LOOKUPS_MAX: Final = 64  # at once


class SwitchLookups:
    """Lookups under way at one switch."""

    def __init__(self, switch: SwitchCore) -> None:
        self._switch = switch
        self._since_s: dict[Name, float] = {}

    def lookup(self, name: Name, now: Timestamps) -> Mapping[str, object]:
        """Return what is known; the first call for a name asks the RIB.

        Raises:
            LocalError: too many names are being looked up.
        """
        now_s, resolver, rib = now.mono_s, self._switch.resolver, self._switch.rib
        self._since_s = {each: since_s for each, since_s in self._since_s.items() if now_s < since_s + IDLE_S}
        since_s = self._since_s.get(name)
        state = "no-rib"
        if rib is not None and since_s is None:
            if len(self._since_s) >= _LOOKUPS_MAX:
                raise LocalError(f"{_LOOKUPS_MAX} names are being looked up; try again in {IDLE_S:g} s")
            self._since_s[name] = now_s
            self._switch.query_name(name, now_s)
            state = "asked"
        elif rib is not None and since_s is not None:
            if resolver.requests.is_open(name) or now_s < since_s + _SETTLE_S:
                state = "asked"
            else:
                del self._since_s[name]
                is_answered = bool(resolver.cache.of(name, now_s)) or resolver.cache.is_negative(name, now_s)
                state = "answered" if is_answered else "no-answer"
        found = [
            _fields(place.proof, switch=place.switch, domain=place.domain, left_s=place.expires_s - now_s)
            for place in resolver.cache.of(name, now_s)
            if place.proof is not None
        ]
        return _result(state, rib, found)


def rib_lookup(rib: RibCore, me: Name, name: Name, now: Timestamps) -> Mapping[str, object]:
    """Return what a RIB stores about a name. Raises ``StoreError``: its store does not answer."""
    rib.state.store.prefetch([name], now)
    found = []
    for route in rib.state.store.routes(name):
        with suppress(StatementError):  # invalid by now
            advertisement = rib.state.verifier.verify(route.advertisement, now.unix_s)
            left_s = route.expires_s - now.mono_s
            found.append(_fields(advertisement, switch=route.switch, domain=route.domain, left_s=left_s))
    return _result("stored", me, found)


def _result(state: str, rib: Name | None, found: Iterable[Mapping[str, object]]) -> Mapping[str, object]:
    advertisers = list(found)
    return {
        "state": state,
        "rib": None if rib is None else rib.to_text(),
        "advertisers": advertisers[:ADVERTISERS_MAX],
        "left_out": max(len(advertisers) - ADVERTISERS_MAX, 0),
    }


def _fields(advertisement: Advertisement, *, switch: Name, domain: Name, left_s: float) -> Mapping[str, object]:
    """Return one advertiser: what it does, where, for how long, and whose certificates say that it may."""
    return {
        "advertiser": advertisement.node.to_text(),
        "right": advertisement.right.value,
        "switch": switch.to_text(),
        "domain": domain.to_text(),
        "lease_s": advertisement.lease_s,
        "left_s": round(max(left_s, 0.0), 1),
        "is_global": advertisement.is_global,
        "holder": advertisement.member.label,
        "holder_domain": advertisement.domain.to_text(),
        "owner_key": advertisement.subject.owner_key.hex(),
        "delegated_by": [link.issuer.to_text() for link in advertisement.chain.links],
        "valid_until_unix_s": advertisement.valid_until_unix_s,
    }
