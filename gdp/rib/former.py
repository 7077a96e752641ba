"""Former advertisers and refusals of names, kept for diagnoses.

Sans-I/O; bounded: of too many, those that were noted or asked for longest ago are forgotten.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

from gdp.errors import DropReason
from gdp.names import Name
from gdp.rib.route import Route
from gdp.trust.lru import Lru

if TYPE_CHECKING:
    from gdp.diagnosis.facts import GoneFact

_NAMES_MAX: Final = 4_096
_ADVERTISERS_MAX: Final = 16  # of one name
_LAPSED: Final = "lapsed"
_WITHDREW: Final = "withdrew"
_Gone: TypeAlias = tuple[str, Name, Name]  # how, and its last switch and that one's domain


class FormerAdvertisers:
    """How advertisers of names left, and why an advertisement was refused last."""

    def __init__(self) -> None:
        self._gone: Lru[dict[Name, _Gone]] = Lru(_NAMES_MAX)
        self._refused: Lru[str] = Lru(_NAMES_MAX)

    def note_gone(self, route: Route, *, is_lapsed: bool) -> None:
        """Note that an advertiser withdrew a name, or that its lease ended."""
        known = self._gone.get(route.name) or {}
        known.pop(route.advertiser, None)
        known[route.advertiser] = (_LAPSED if is_lapsed else _WITHDREW, route.switch, route.domain)
        if len(known) > _ADVERTISERS_MAX:
            del known[next(iter(known))]
        self._gone.put(route.name, known)

    def note_refused(self, name: Name, reason: DropReason) -> None:
        """Note why an advertisement of a name was refused."""
        self._refused.put(name, reason.label)

    def gone(self, name: Name) -> tuple[GoneFact, ...]:
        """Return the advertisers of a name that left, those that are back included."""
        from gdp.diagnosis.facts import GoneFact  # a node gathers facts for who asks

        return tuple(
            GoneFact(advertiser=each.to_text(), how=how, switch=switch.to_text(), domain=domain.to_text())
            for each, (how, switch, domain) in (self._gone.get(name) or {}).items()
        )

    def refused(self, name: Name) -> str:
        """Return the label of the newest refusal of a name, or an empty text."""
        return self._refused.get(name) or ""
