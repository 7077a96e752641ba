"""Keeping of exposed topics in capsules, by the delegations of this proxy, and the events around which they are kept.

I/O, by its rings.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.capsule.late_join import LateJoin
from gdp.client.participant import Message, Participant, Topic
from gdp.client.publisher import Publisher
from gdp.crypto.identity import Identity
from gdp.due_queue import earliest
from gdp.errors import GdpError, LocalError, StoreError
from gdp.intervals import PACE_S
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore
from gdp.sansio import Timestamps
from gdp.session.keeping import CapsuleKeeper
from gdp.session.protocol.nearest_holder import NearestHolder
from gdp.trust.right import Right
from proxy.bridge.faults import Fault, Faults
from proxy.config.history import History
from proxy.config.keep import UPLINK_LOST, Keep

log = logging.getLogger(__name__)

_FAULTS: Final = {each.value: None for each in Fault if each is not Fault.NOT_KEPT}
_EVENTS: Final = (UPLINK_LOST, *_FAULTS)


@dataclass(slots=True)
class _Joining:
    local: str
    join: LateJoin
    stores: tuple[str, ...]
    deliver: Callable[[float], None]
    holder: NearestHolder | None = None
    choices: int = 0  # that were logged
    due_s: float = 0.0


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
        self._failing: set[Name] = set()  # capsules
        self._when: dict[str, set[Name]] = {}  # topics that each event marks
        self._fault_counts: dict[str, int] = {}
        self._had_path = False
        self._joins: dict[Name, _Joining] = {}
        self.capsules = CapsuleKeeper(member, identity, folder, start=secrets.randbits(63))

    def keep(self, local: str, topic: Topic, publisher: Publisher, keep: Keep, unix_s: float) -> str:
        """Keep what the publisher of a local name publishes; return why that is not possible, empty if it is."""
        self._local[topic.name] = local
        try:
            for event in keep.when:
                if not event.startswith("/") and event not in _EVENTS:
                    raise LocalError(f"keep: when: {event} is no event; expected a topic or {', '.join(_EVENTS)}")
                self._when.setdefault(event, set()).add(topic.name)
            holders = [self._holder(each) for each in keep.to]
            self.capsules.keep(topic, publisher, holders, keep.disk, unix_s, keep.around_ns, keep.capsule)
        except GdpError as error:
            return str(error)
        return ""

    def mark(self, name: str, unix_s: float) -> int:
        """Mark an event in all topics that are kept; return how many. Raises ``StoreError``: a disk refuses."""
        return self._mark(name, set(self.capsules.topics), unix_s)

    def handle_event(self, event: str, faults: Faults, which: str = "") -> None:
        """Mark an event in the topics whose rule states it: a message of a local topic, a call, or another one.

        Args:
            which: a call: the client of a service, or the id of a goal.
        """
        if event in self._when:
            try:
                self._mark(f"{event} {which}".rstrip(), self._when[event], time.time())
            except StoreError as error:
                faults.report(event, Fault.NOT_KEPT, str(error))

    def _mark(self, name: str, topics: set[Name], unix_s: float) -> int:
        found = [kept for topic, kept in self.capsules.topics.items() if topic in topics]
        for kept in {each.name: each for each in found}.values():
            kept.mark(name, int(unix_s * 1e9))
        return len(found)

    def join(self, local: str, topic: Topic, history: History, deliver: Callable[[float], None]) -> LateJoin:
        """Return a topic's past from the nearest holder, for a late reader; ``deliver`` is called when it has come."""
        join = LateJoin(topic, time.time(), history.age_s, history.messages, history.max_bytes)
        self._joins[topic.name] = _Joining(local, join, history.store or (), deliver)
        return join

    def leave(self, topic: Name) -> None:
        """Read a topic's past no more."""
        self._joins.pop(topic, None)

    def _ask(self, joining: _Joining, now_s: float, faults: Faults) -> None:
        """Ask a holder for the next part of a topic's past."""
        join, holder, joining.due_s = joining.join, joining.holder, now_s + PACE_S
        try:
            if holder is None:
                clients = {each: self.capsules.client(self._holder(each)) for each in joining.stores}
                holder = joining.holder = NearestHolder(clients)
            holder.handle_timer(now_s)
            if (answer := holder.poll_answer()) is not None:
                join.handle_response(answer, now_s)
            if len(holder.choices) > joining.choices:
                joining.choices = len(holder.choices)
                log.info("past of %s is %s", joining.local, holder.choices[-1].words())
            if holder.is_idle and (request := join.next_request(now_s)) is not None:
                holder.begin(request, now_s)
        except GdpError as error:
            join.give_up()
            faults.report(joining.local, Fault.NOT_KEPT, f"no past from {', '.join(joining.stores)}: {error}")
        joining.deliver(now_s)

    def release(self, topic: Name, unix_s: float) -> None:
        """Keep a topic no more."""
        self.capsules.release(topic, unix_s)

    def receive(self, message: Message, now_s: float) -> None:
        """Process a message of a holder. Raises ``RemoteError``: it is malformed."""
        self.capsules.receive(message, now_s)

    def handle(self, now: Timestamps, faults: Faults) -> None:
        """Write and upload what is there, and report what is not kept or not taken by its holder."""
        self._find_events(faults, now.mono_s)
        self.capsules.handle(now)
        for joining in list(self._joins.values()):
            self._ask(joining, now.mono_s, faults)
        for kept in self.capsules.capsules:
            locals_ = [self._local[each] for each in kept.ring.descriptor.topics if each in self._local]
            for detail in kept.poll_faults():
                self._failing.add(kept.name)
                for local in locals_:
                    faults.report(local, Fault.NOT_KEPT, detail)
            if kept.name in self._failing and not kept.uploader.is_refused and kept.is_uploaded:
                self._failing.remove(kept.name)
                for local in locals_:
                    faults.clear(local, Fault.NOT_KEPT)

    def _find_events(self, faults: Faults, now_s: float) -> None:
        if not self._when:
            return
        if UPLINK_LOST in self._when:
            has_path = self._member.attachment.switch is not None and self.capsules.has_path(now_s)
            if self._had_path and not has_path:
                self.handle_event(UPLINK_LOST, faults)
            self._had_path = has_path
        counts = faults.counts if self._when.keys() & _FAULTS.keys() else {}
        for word in [word for word, count in counts.items() if count > self._fault_counts.get(word, 0)]:
            self.handle_event(word, faults)
        self._fault_counts = dict(counts)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        due_s = [each.due_s for each in self._joins.values() if not each.join.is_done]
        return earliest(self.capsules.get_timer(), *due_s)

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
