"""What a switch holds that rests on certificates: claims of attached nodes, places of names, branches of trees.

Sans-I/O. The index finds what a revocation concerns; what has gone meanwhile is left out (``trust/holdings.py``).
"""

from __future__ import annotations

from typing import NamedTuple

from gdp.names import Name
from gdp.switch.attached import Attached
from gdp.switch.places import Place, Places
from gdp.switch.planter import Planter
from gdp.switch.trees import At
from gdp.trust.claim import Claim
from gdp.trust.holdings import Holdings

__all__ = ["AttachedClaim", "Held", "JoinedBranch", "KnownPlace"]


class AttachedClaim(NamedTuple):
    """A claim that a node attached at ``at`` brought."""

    name: Name
    node: Name
    at: At


class KnownPlace(NamedTuple):
    """Where an advertiser of a name is."""

    name: Name
    advertiser: Name


class JoinedBranch(NamedTuple):
    """A branch that a switch below asked for."""

    topic: Name
    publisher: Name
    at: At


class Held:
    """The index of one switch."""

    def __init__(self, attached: Attached, places: Places, planter: Planter) -> None:
        self._attached = attached
        self._places = places
        self._planter = planter
        self._holdings = Holdings[AttachedClaim | KnownPlace | JoinedBranch](self._is_held)

    def note_claim(self, claim: Claim, at: At) -> None:
        """Note the claim of an attached node."""
        self._holdings.note(AttachedClaim(claim.name, claim.node, at), claim)

    def note_place(self, place: Place) -> None:
        """Note what a RIB or a switch proved of an advertiser."""
        if place.proof is not None:
            self._holdings.note(KnownPlace(place.name, place.advertiser), place.proof)

    def note_branch(self, topic: Name, publisher: Name, at: At, evidence: Claim) -> None:
        """Note the reader's claim that a join from below carried."""
        self._holdings.note(JoinedBranch(topic, publisher, at), evidence)

    def resting_on(self, fingerprint: bytes) -> list[AttachedClaim | KnownPlace | JoinedBranch]:
        """Return what rests on a certificate."""
        return self._holdings.resting_on(fingerprint)

    def has_issuer(self, key: bytes) -> bool:
        """Return whether something rests on a certificate that this key, 33 bytes, issued."""
        return self._holdings.has_issuer(key)

    def _is_held(self, holder: AttachedClaim | KnownPlace | JoinedBranch) -> bool:
        if isinstance(holder, AttachedClaim):
            is_reader = self._planter.claim_of(holder.name, holder.at) is not None
            return is_reader or self._attached.get(holder.name, holder.node) is not None
        if isinstance(holder, KnownPlace):
            return self._places.get(holder.name, holder.advertiser) is not None
        tree = self._planter.trees.get(holder.topic, holder.publisher)
        return tree is not None and holder.at in tree.branches
