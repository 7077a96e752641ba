"""Rules about delegations and advertisements.

Sans-I/O. Each rule returns sentence and command where its cause holds, else None.
"""

from __future__ import annotations

import shlex

from gdp.diagnosis.network_rules import Found
from gdp.diagnosis.view import End, View, short

__all__ = [
    "advertisement_refused",
    "delegation_expired",
    "delegation_missing",
    "delegation_revoked",
    "quota",
    "right_missing",
]


def delegation_expired(view: View) -> Found:
    """A delegation is no longer valid."""
    for end in view.ends:
        flow = end.flow
        if flow.delegated == "expired" or (flow.refused == "expired" and flow.delegated != "yes"):
            text = f"The delegation to {flow.right} {flow.local} {end.place} has expired."
            return text, _delegate(end)
    for rib in view.facts.ribs:
        if rib.refused == "expired" and not view.advertisers:
            text = f"RIB {short(rib.name)} refuses its advertisement: the delegation or membership has expired."
            return text, "gdp delegate name --help"
    return None


def delegation_revoked(view: View) -> Found:
    """A delegation was revoked."""
    for end in view.ends:
        if "revoked" in (end.flow.delegated, end.flow.refused):
            return f"The right to {end.flow.right} {end.flow.local} {end.place} was revoked.", _delegate(end)
    for rib in view.facts.ribs:
        if rib.refused == "revoked" and not view.advertisers:
            text = f"RIB {short(rib.name)} refuses its advertisement: the right was revoked."
            return text, "gdp delegate name --help"
    return None


def delegation_missing(view: View) -> Found:
    """There is no delegation for a rule."""
    for end in view.ends:
        flow = end.flow
        if flow.overlay and flow.delegated not in ("yes", "lacks-right"):
            why = "" if flow.delegated == "no" else f" ({flow.delegated})"
            return f"There is no valid delegation to {flow.right} {flow.local} {end.place}{why}.", _delegate(end)
        if flow.problem == "no-delegation" and flow.delegated != "lacks-right":
            return f"There is no delegation to {flow.right} {flow.local} {end.place}.", _delegate(end)
    return None


def right_missing(view: View) -> Found:
    """A delegation gives other rights."""
    for end in view.ends:
        if end.flow.delegated == "lacks-right":
            text = f"The delegation of {end.flow.local} {end.place} does not give the right to {end.flow.right} it."
            return text, _delegate(end)
    return None


def quota(view: View) -> Found:
    """A quota of a switch or RIB is used up."""
    for end in view.ends:
        if end.flow.refused == "quota":
            text = f"The advertisement of {end.flow.local} {end.place} is refused: a quota of names is used up."
            return text, "gdp status RIB_DIR"
    if any(rib.refused == "quota" for rib in view.facts.ribs) and not view.advertisers:
        return "The RIB refuses its advertisement: a quota of names is used up.", "gdp status RIB_DIR"
    return None


def advertisement_refused(view: View) -> Found:
    """An advertisement is refused for another reason."""
    for end in view.ends:
        if end.flow.advertised == "refused":
            text = f"The advertisement of {end.flow.local} {end.place} is refused: {end.flow.refused}."
            return text, "gdp audit --help"
    return None


def _delegate(end: End) -> str:
    flow = end.flow
    words = ["gdp", "delegate", "name", "--owner", "OWNER", "--card", "node.card", "--right", flow.right]
    words += ["--kind", flow.kind, "--name", flow.local, "--type", flow.type_name, "--out", "NAME.delegation"]
    return shlex.join(words)
