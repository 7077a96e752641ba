"""Index of the certificate-dependent state of a switch: attached nodes' advertisements, locations, tree branches.

Sans-I/O. The index finds what a revocation concerns; entries that are gone meanwhile are left out
(``trust/evidence_index.py``).
"""

from __future__ import annotations

from typing import NamedTuple

from gdp.names import Name
from gdp.switch.attached_readers import AttachedReaders
from gdp.switch.local_advertisements import LocalAdvertisements
from gdp.switch.name_cache import NameCache
from gdp.switch.trees import Downstream, Trees
from gdp.trust.evidence_index import Holdings


class AttachedAdvertisement(NamedTuple):
    """An advertisement of a node that is attached at ``at``."""

    name: Name
    node: Name
    at: Downstream


class KnownLocation(NamedTuple):
    """The location of an advertiser of a name."""

    name: Name
    advertiser: Name


class JoinedBranch(NamedTuple):
    """A branch that a downstream switch requested."""

    topic: Name
    publisher: Name
    at: Downstream


class Dependents(Holdings[AttachedAdvertisement | KnownLocation | JoinedBranch]):
    """The index of one switch."""

    def __init__(self, attached: LocalAdvertisements, cache: NameCache, readers: AttachedReaders, trees: Trees) -> None:
        self._attached = attached
        self._cache = cache
        self._readers = readers
        self._trees = trees
        super().__init__(self._has)

    def _has(self, holder: AttachedAdvertisement | KnownLocation | JoinedBranch) -> bool:
        if isinstance(holder, AttachedAdvertisement):
            is_reader = self._readers.advertisement_of(holder.name, holder.at) is not None
            return is_reader or self._attached.get(holder.name, holder.node) is not None
        if isinstance(holder, KnownLocation):
            return self._cache.get(holder.name, holder.advertiser) is not None
        tree = self._trees.get(holder.topic, holder.publisher)
        return tree is not None and holder.at in tree.branches
