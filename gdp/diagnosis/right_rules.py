"""Rules about delegations and advertisements.

Sans-I/O. Each rule yields sentence and command where its cause holds; the first counts.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import Final

from gdp.diagnosis.answer import Cause
from gdp.diagnosis.view import End, Found, Rule, View, short


def delegation_expired(view: View) -> Iterator[Found]:
    """A delegation is no longer valid."""
    for end in view.ends:
        flow = end.flow
        if flow.delegated == "expired" or (flow.refused == "expired" and flow.delegated != "yes"):
            text = f"The delegation to {flow.right} {flow.local} {end.place} has expired."
            yield text, _delegate(end)
    for rib in view.facts.ribs:
        if rib.refused == "expired" and not view.advertisers:
            text = f"RIB {short(rib.name)} refuses its advertisement: the delegation or membership has expired."
            yield text, "gdp delegate name --help"


def delegation_revoked(view: View) -> Iterator[Found]:
    """A delegation was revoked."""
    for end in view.ends:
        if "revoked" in (end.flow.delegated, end.flow.refused):
            yield f"The right to {end.flow.right} {end.flow.local} {end.place} was revoked.", _delegate(end)
    for rib in view.facts.ribs:
        if rib.refused == "revoked" and not view.advertisers:
            text = f"RIB {short(rib.name)} refuses its advertisement: the right was revoked."
            yield text, "gdp delegate name --help"


def delegation_missing(view: View) -> Iterator[Found]:
    """There is no delegation for a rule."""
    for end in view.ends:
        flow = end.flow
        if flow.overlay and flow.delegated not in ("yes", "lacks-right"):
            why = "" if flow.delegated == "no" else f" ({flow.delegated})"
            yield f"There is no valid delegation to {flow.right} {flow.local} {end.place}{why}.", _delegate(end)
        if flow.problem == "no-delegation" and flow.delegated != "lacks-right":
            yield f"There is no delegation to {flow.right} {flow.local} {end.place}.", _delegate(end)


def right_missing(view: View) -> Iterator[Found]:
    """A delegation gives other rights."""
    for end in view.ends:
        if end.flow.delegated == "lacks-right":
            text = f"The delegation of {end.flow.local} {end.place} does not give the right to {end.flow.right} it."
            yield text, _delegate(end)


def quota(view: View) -> Iterator[Found]:
    """A quota of a switch or RIB is used up."""
    for end in view.ends:
        if end.flow.refused == "quota":
            text = f"The advertisement of {end.flow.local} {end.place} is refused: a quota of names is used up."
            yield text, "gdp status RIB_DIR"
    if any(rib.refused == "quota" for rib in view.facts.ribs) and not view.advertisers:
        yield "The RIB refuses its advertisement: a quota of names is used up.", "gdp status RIB_DIR"


def advertisement_refused(view: View) -> Iterator[Found]:
    """An advertisement is refused for another reason."""
    for end in view.ends:
        if end.flow.advertised == "refused":
            text = f"The advertisement of {end.flow.local} {end.place} is refused: {end.flow.refused}."
            yield text, "gdp audit --help"


def _delegate(end: End) -> str:
    flow = end.flow
    words = ["gdp", "delegate", "name", "--owner", "OWNER", "--card", "node.card", "--right", flow.right]
    words += ["--kind", flow.kind, "--name", flow.local, "--type", flow.type_name, "--out", "NAME.delegation"]
    return shlex.join(words)


RULES: Final[dict[Cause, Rule]] = {
    Cause.DELEGATION_EXPIRED: delegation_expired,
    Cause.DELEGATION_REVOKED: delegation_revoked,
    Cause.DELEGATION_MISSING: delegation_missing,
    Cause.RIGHT_MISSING: right_missing,
    Cause.QUOTA: quota,
    Cause.ADVERTISEMENT_REFUSED: advertisement_refused,
}
