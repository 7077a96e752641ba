"""Keeping of what a session publishes: its keeper, as one of the services that the session's core handles.

I/O, by its keeper: the disk, and the wall clock.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from gdp.client.participant import Message, Topic
from gdp.client.publisher import Publisher
from gdp.crypto.identity import Identity
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.session.keeping import CapsuleKeeper
from gdp.session.protocol.core import SessionCore

CAPSULES: Final = "capsules"  # folder of rings, within that of the state
log = logging.getLogger(__name__)


class KeptTopics:
    """Topics of a session that are kept, in ``folder`` and at holders."""

    def __init__(self, core: SessionCore, identity: Identity, folder: Path) -> None:
        self._core = core
        self._keeper = CapsuleKeeper(core.member, identity, folder, start=secrets.randbits(63))

    def keep(self, topic: Topic, publisher: Publisher, holders: Sequence[Topic], most_bytes: int) -> None:
        """Keep what a publisher publishes from now on. Raises ``GdpError``: as ``CapsuleKeeper.keep``."""
        self._keeper.keep(topic, publisher, holders, most_bytes, time.time())
        self._core.add_service(self, [holder.name for holder in holders])

    def is_uploaded(self, topic: Name) -> bool:
        """Return whether each holder has confirmed all that was published."""
        self._keeper.flush(time.time())
        kept = self._keeper.topics.get(topic)
        return kept is not None and kept.is_uploaded

    def release(self, topic: Name) -> None:
        """Keep a topic no more."""
        self._keeper.release(topic, time.time())

    def receive(self, message: Message, now_s: float) -> None:
        """Process a message of a holder. Raises ``RemoteError``: it is malformed."""
        self._keeper.receive(message, now_s)
        self.handle_timer(now_s)

    def handle_timer(self, now_s: float) -> None:
        """Write and upload what is there."""
        self._keeper.handle(Timestamps(now_s, time.time()))
        for kept in self._keeper.capsules:
            for fault in kept.poll_faults():
                log.warning("history not kept capsule=%s reason=%s", kept.name.short, fault)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return self._keeper.get_timer()

    def close(self) -> None:
        """Put everything on the disk; the next session that keeps a topic uploads what is left."""
        self._keeper.close(time.time())
