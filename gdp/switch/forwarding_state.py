"""Forwarding state of a switch: the objects that its parts share, and the index of what depends on certificates.

Sans-I/O. ``core.py`` builds it once and hands it to every part. A part that handles a statement changes it and sends by
its outbox.
"""

from __future__ import annotations

from typing import NamedTuple

from gdp.control.neighbour_table import NeighbourTable
from gdp.crypto.identity import Identity
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.switch.attached_readers import AttachedReaders
from gdp.switch.local_advertisements import LocalAdvertisements
from gdp.switch.name_cache import NameCache
from gdp.switch.name_resolver import NameResolver
from gdp.switch.outbox import Outbox
from gdp.switch.paths import Paths
from gdp.switch.table import Table
from gdp.switch.trees import Downstream, Trees
from gdp.trust.domain import Policy
from gdp.trust.evidence_index import Holdings
from gdp.trust.verifier import AdvertisementVerifier


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


class ForwardingState:
    """State of one switch that its parts share.

    Args:
        lease_s: seconds for which the RIB keeps a watch.

    Attributes:
        me: name of this switch.
        table: entries of the data plane.
        paths: to the switches and RIBs that link states name.
        neighbours: of all ports.
        outbox: frames to send.
        resolver: names, with the cache of their locations.
        attached: advertisements of attached nodes that others must find.
        readers: attached nodes that read topics.
        trees: multicast trees that pass here.
        dependents: which certificates ``attached``, ``readers``, ``trees`` and known locations depend on.
        verifier: of advertisements; shared, so that a known one is cheap.
        now: of the last call of the core.
    """

    __slots__ = (
        "attached", "dependents", "identity", "me", "neighbours", "now", "outbox", "paths", "policy",
        "readers", "resolver", "table", "trees", "verifier",
    )  # fmt: skip

    def __init__(
        self,
        identity: Identity,
        policy: Policy,
        *,
        table: Table,
        paths: Paths,
        neighbours: NeighbourTable,
        outbox: Outbox,
        lease_s: float,
    ) -> None:
        self.identity = identity
        self.me = identity.name
        self.policy = policy
        self.table = table
        self.paths = paths
        self.neighbours = neighbours
        self.outbox = outbox
        self.resolver = NameResolver(identity.name, lease_s)
        self.attached = LocalAdvertisements()
        self.readers = AttachedReaders()
        self.trees = Trees()
        self.dependents = Dependents(self.attached, self.resolver.cache, self.readers, self.trees)
        self.verifier = AdvertisementVerifier(policy)
        self.now = Timestamps(0.0, 0.0)
