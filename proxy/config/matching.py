"""Rule matching: a rule with a full name precedes every pattern, and among equals the first of the file applies."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import TypeAlias

from gdp.metadata import Metadata
from gdp.names import Name
from gdp.ros_names import Kind
from proxy.config.rule import Rule

Fault: TypeAlias = "tuple[tuple[str | int, ...], str]"  # the wrong key, and its fault


def choose(rules: Sequence[Rule], kind: Kind, local_name: str, type_name: str = "") -> Rule | None:
    """Return the rule of one direction for a local name; None: it stays local.

    A rule with that full name is final: if its type differs, no pattern replaces it.

    Args:
        type_name: empty while unknown.
    """
    fitting = [rule for rule in rules if rule.kind == kind and rule.matches(local_name)]
    full = [rule for rule in fitting if not rule.is_pattern]
    return next((rule for rule in full or fitting if rule.fits_type(type_name)), None)


def imported(rules: Sequence[Rule], name: Name, metadata: Metadata) -> tuple[Rule, str] | None:
    """Return the rule for an overlay name, and the local name; None: no rule applies to it."""
    for rule in sorted(rules, key=lambda rule: rule.is_pattern):
        local = rule.local_of(metadata)
        if local is not None and metadata.name(rule.owner.compressed) == name:
            return rule, local
    return None


def clashes(
    expose: Sequence[Rule], imports: Sequence[Rule], place_of: Callable[[Rule], Hashable | None]
) -> Iterator[Fault]:
    """Yield the conflicts between rules: two of one direction, or a service on both sides, for one name."""
    for side, rules in (("expose", expose), ("import", imports)):
        seen = _Seen(side, place_of)
        for index, rule in enumerate(rules):
            reason = seen.find(rule)
            if reason is not None:
                yield (side, index, "name"), reason
            seen.add(index, rule)
    exposed = _Seen("expose", place_of)
    for index, rule in enumerate(expose):
        if rule.kind != "topic" and not rule.is_pattern:
            exposed.add(index, rule)
    for index, rule in enumerate(imports):
        if rule.kind != "topic" and (reason := exposed.find(rule)) is not None:
            yield ("import", index, "name"), f"{reason}; one machine serves {_a(rule.kind)} or calls it, not both"


class _Seen:
    """Rules of one direction, indexed by what only one of them may apply to."""

    def __init__(self, side: str, place_of: Callable[[Rule], Hashable | None]) -> None:
        self._side = side
        self._place_of = place_of
        self._rules: dict[Hashable, list[tuple[int, Rule]]] = {}

    def add(self, index: int, rule: Rule) -> None:
        for key, _ in self._keys(rule):
            self._rules.setdefault(key, []).append((index, rule))

    def find(self, rule: Rule) -> str | None:
        """Return how an earlier rule applies to the same name."""
        for key, what in self._keys(rule):
            for index, earlier in self._rules.get(key, ()):
                if rule.fits_type(earlier.type_name):
                    return f"{self._side}[{index}] {what}"
        return None

    def _keys(self, rule: Rule) -> Iterator[tuple[Hashable, str]]:
        overlay = (rule.kind, rule.global_name_of(rule.name), tuple(sorted(rule.extra.items())), rule.owner.compressed)
        yield overlay, f"gives the same name: {rule.name}"
        if not rule.is_pattern or self._side == "expose":  # patterns of several owners may be imported into one graph
            # The topics of several robots may become one topic here, such as /tf.
            robot = rule.prefix if self._side == "import" and rule.kind == "topic" else None
            local = (rule.kind, rule.local, robot, self._place_of(rule))
            yield local, f"is about {rule.local} of this machine, too"


def _a(kind: Kind) -> str:
    return "an action" if kind == "action" else f"a {kind}"
