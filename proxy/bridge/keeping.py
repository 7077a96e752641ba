"""Keeping of exposed topics in capsules, by the delegations of this proxy.

I/O, by its rings.
"""

from __future__ import annotations

import secrets
from pathlib import Path

from gdp.client.participant import Message, Participant, Topic
from gdp.client.publisher import Publisher
from gdp.crypto.identity import Identity
from gdp.errors import GdpError, LocalError
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore
from gdp.sansio import Timestamps
from gdp.session.keeping import CapsuleKeeper
from gdp.trust.right import Right
from proxy.bridge.faults import Fault, Faults
from proxy.config.keep import Keep


class TopicKeeper:
    """Keeper of the topics of one proxy.

    Args:
        folder: of the rings.
        held: the delegations, with that to call the holder.

    Attributes:
        capsules: what is kept.
    """

    def __init__(self, member: Participant, identity: Identity, folder: Path, held: DelegationStore) -> None:
        self._member = member
        self._held = held
        self._local: dict[Name, str] = {}  # names of the topics that are kept
        self._failing: set[Name] = set()
        self.capsules = CapsuleKeeper(member, identity, folder, start=secrets.randbits(63))

    def keep(self, local: str, topic: Topic, publisher: Publisher, keep: Keep, unix_s: float) -> str:
        """Keep what the publisher of a local name publishes; return why that is not possible, empty if it is."""
        self._local[topic.name] = local
        try:
            self.capsules.keep(topic, publisher, [self._holder(each) for each in keep.to], keep.disk, unix_s)
        except GdpError as error:
            return str(error)
        return ""

    def release(self, topic: Name, unix_s: float) -> None:
        """Keep a topic no more."""
        self.capsules.release(topic, unix_s)

    def receive(self, message: Message, now_s: float) -> None:
        """Process a message of a holder. Raises ``RemoteError``: it is malformed."""
        self.capsules.receive(message, now_s)

    def handle(self, now: Timestamps, faults: Faults) -> None:
        """Write and upload what is there, and report what is not kept or not taken by its holder."""
        self.capsules.handle(now)
        for name, kept in (*self.capsules.topics.items(), *self.capsules.ended.items()):
            for detail in kept.poll_faults():
                self._failing.add(name)
                faults.report(self._local[name], Fault.NOT_KEPT, detail)
            if name in self._failing and not kept.uploader.is_refused and kept.is_uploaded:
                self._failing.remove(name)
                faults.clear(self._local[name], Fault.NOT_KEPT)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return self.capsules.get_timer()

    def renew(self, held: DelegationStore) -> None:
        """Replace the delegations: new epochs of the holders' services take effect."""
        self._held = held
        for topic in held:
            if self.capsules.is_asked(topic.name):
                self._member.renew(topic)

    def _holder(self, to: str) -> Topic:
        found = [topic for topic in self._held if Right.CALL in topic.delegation.rights and _is_named(topic, to)]
        if len(found) != 1:
            raise LocalError(
                f"keep: {len(found)} delegations to call {to} in {self._held.directory}; the owner makes one with"
                f" 'gdp delegate name --kind service --name {to} --right call'"
            )
        return found[0]


def _is_named(topic: Topic, to: str) -> bool:
    metadata = topic.delegation.metadata
    return topic.name.to_text() == to.lower() or (metadata is not None and metadata.get("name") == to)
