"""Delegations of a node, each verified, with the secrets in them.

I/O; it reads files.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from gdp.client.participant import Topic
from gdp.crypto.identity import Identity
from gdp.errors import GdpError, LocalError, RemoteError
from gdp.limits import CLOCK_SKEW_S
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.stores.keyring import load_delegations
from gdp.trust.delegation import Delegation
from gdp.trust.grants import EPOCH_S, begun_epochs
from gdp.trust.right import Right

log = logging.getLogger(__name__)


class DelegationStore:
    """Delegations by name.

    Args:
        directory: of delegation files; an invalid delegation is logged and left out.

    Attributes:
        left_out: why delegations were left out, by name: the label of a ``DropReason``, or a text.

    Raises:
        LocalError: a file is malformed, or readable for others.
    """

    def __init__(self, directory: Path, identity: Identity) -> None:
        self.directory = directory
        self._topics: dict[Name, Topic] = {}
        self.left_out: dict[Name, str] = {}
        for delegation in load_delegations(directory):
            try:
                self._topics[delegation.name] = open_delegation(delegation, identity)
            except GdpError as error:
                meant = delegation.metadata["name"] if delegation.metadata else delegation.name.short
                self.left_out[delegation.name] = error.reason.label if isinstance(error, RemoteError) else str(error)
                log.warning("delegation left out of=%s reason=%s", meant, error)

    def __iter__(self) -> Iterator[Topic]:
        return iter(self._topics.values())

    def get(self, name: Name) -> Topic | None:
        """Return the delegation of a name with any rights; None if there is none."""
        return self._topics.get(name)

    def find(self, name: Name, right: Right) -> Topic | None:
        """Return the delegation of a name if it gives this right, else None."""
        topic = self._topics.get(name)
        return topic if topic is not None and right in topic.delegation.rights else None

    def described(self, right: Right) -> Iterator[tuple[Metadata, Name]]:
        """Yield metadata and name of the delegations with this right whose owner added the metadata."""
        for topic in self._topics.values():
            if right in topic.delegation.rights and topic.delegation.metadata is not None:
                yield topic.delegation.metadata, topic.name


def open_delegation(delegation: Delegation, identity: Identity) -> Topic:
    """Return a delegation verified, with its secrets. Raises ``GdpError``: it is not valid now, or has no secret."""
    delegation.verify(identity, time.time())
    secrets = {epoch: grant.secret for epoch, grant in delegation.open(identity).items()}
    if not secrets:
        raise LocalError("the delegation holds no secret of any epoch")
    unix_s = time.time()
    return Topic(delegation, begun_epochs(secrets, unix_s + CLOCK_SKEW_S), begun_epochs(secrets, unix_s))


class EpochTimer:
    """Timer that has delegations read again when a day's epoch begins, here or by the clock of another node.

    A reader uses a new epoch from ``CLOCK_SKEW_S`` before its day on, because a publisher's clock may be ahead.

    Args:
        reload: reads them; an error stays with it.
    """

    def __init__(self, reload: Callable[[], None]) -> None:
        self._reload = reload
        self._days: tuple[float, float] | None = None

    def handle_timer(self, now: Timestamps) -> None:
        """Reload if an epoch has begun since the last call."""
        days = now.unix_s // EPOCH_S, (now.unix_s + CLOCK_SKEW_S) // EPOCH_S
        if self._days not in (None, days):
            self._reload()
        self._days = days
