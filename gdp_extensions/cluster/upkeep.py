"""Upkeep of a store in a cluster: changes by other RIBs are received and passed to the RIB's watchers."""

from __future__ import annotations

import logging
from typing import Final

from gdp.config.config import ClusterConfig
from gdp.errors import LocalError
from gdp.intervals import UPKEEP_S
from gdp.nodes.rib_upkeep import Upkeep
from gdp.rib.core import RibCore
from gdp.sansio import Timestamps
from gdp.trust.domain import Policy
from gdp.trust.verifier import AdvertisementVerifier
from gdp_extensions.cluster.link import ClusterLink
from gdp_extensions.cluster.store import ClusterStore, load_functions

log = logging.getLogger(__name__)

KEEP_ALIVE_S: Final = 0.25


class ClusterUpkeep(Upkeep):
    """A connection to the cluster and the store over it.

    Attributes:
        is_complete: each primary has the RIB's functions, as far as is known.

    Raises:
        LocalError: the cluster is not reachable, or refuses the RIB's functions.
    """

    every_s = KEEP_ALIVE_S

    def __init__(self, cluster: ClusterConfig, policy: Policy, *, allow_unowned: bool) -> None:
        self._link = ClusterLink(cluster)
        self.sources = (self._link,)  # the connections that listen, as one source
        self.is_complete = load_functions(self._link)
        self._load_at_s = float("-inf")
        if not self.is_complete:
            log.warning("cluster incomplete; the RIB starts without the primaries that do not answer")
        self.store = self._cluster = ClusterStore(
            self._link, AdvertisementVerifier(policy, allow_unowned=allow_unowned)
        )
        self._rib: RibCore | None = None
        self._failures = 0

    def start(self, rib: RibCore, now: Timestamps) -> None:
        """Listen for changes."""
        self._rib = rib
        self.work(now)

    def work(self, now: Timestamps) -> None:
        """Report the changes of other RIBs, and maintain the connections."""
        self._link.keep_alive(now.mono_s)
        if self._cluster.lacks_functions:
            self._cluster.lacks_functions = False
            if self.is_complete:
                log.warning("cluster incomplete; a primary lacks the RIB's functions")
            self.is_complete = False
        if not self.is_complete and now.mono_s >= self._load_at_s:
            self._complete(now.mono_s)
        if self._rib is not None:
            self._rib.changed(self._cluster.changed(), now)
        if self._link.failures != self._failures:
            log.warning("cluster failures=%d; requests are refused where no primary answers", self._link.failures)
            self._failures = self._link.failures

    def _complete(self, now_s: float) -> None:
        """Load the functions into the primaries that did not respond at the start."""
        self._load_at_s = now_s + UPKEEP_S
        try:
            self.is_complete = load_functions(self._link)
        except LocalError as error:
            log.warning("%s", error)
            return
        if self.is_complete:
            log.info("cluster complete")

    def close(self) -> None:
        """Close the connections."""
        self._link.close()
