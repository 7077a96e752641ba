"""Keeping of published topics in capsules: what a publisher seals goes to the ring on the disk, and on to a holder.

I/O, by its ring; the loop that drives the member calls ``handle``. Requests to the holder have the priority
``background``, so they take what live traffic leaves. One batch is under way for each capsule.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from gdp.capsule.chain import CHECKPOINT_NS, ChainWriter
from gdp.capsule.descriptor import TOPICS_MAX, Descriptor, TopicRight
from gdp.capsule.holder import HolderRequest
from gdp.capsule.record import RecordType
from gdp.capsule.upload import Uploader
from gdp.capsule.windows import Mark, Place, Windows
from gdp.client.participant import Message, Participant, Topic
from gdp.client.publisher import Publisher
from gdp.client.send_options import SendOptions
from gdp.crypto.envelope import Sealed
from gdp.crypto.identity import Identity
from gdp.due_queue import earliest
from gdp.errors import GdpError, LocalError, StoreError
from gdp.intervals import PACE_S, SCHEDULED_S, TICK_S
from gdp.limits import COST_UNREACHABLE, WINDOW_BYTES
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.service.replication import Mode, Replication
from gdp.session.protocol.client_core import CALL_TIMEOUT_S, Call, ClientCore
from gdp.session.protocol.errors import SessionTimeoutError
from gdp.stores.capsule_ring import CapsuleRing

log = logging.getLogger(__name__)

_ONE: Final = Replication(Mode.SOME, copies=1)
_BACKGROUND: Final = SendOptions(priority="background")


class _Waiting(NamedTuple):
    type: RecordType
    topic: Name | None  # None: a mark, in all topics
    frames: tuple[Sealed, ...]
    sequence: int = 0
    messages: int = 0
    mark: Mark | None = None

    @property
    def size_bytes(self) -> int:
        return sum(each.size_bytes for each in self.frames)


def _asked(client: ClientCore, request: HolderRequest, now_s: float) -> Call:
    """Return the call, begun now, that asks a holder."""
    call = Call(payload=request.to_cbor(), timeout_s=CALL_TIMEOUT_S, replication=_ONE)
    client.begin(call, now_s)
    return call


class _Upload:
    """Upload of one capsule's records to one holder.

    Attributes:
        holder: name of its service.
    """

    def __init__(self, ring: CapsuleRing, holder: Name) -> None:
        self._ring = ring
        self.holder = holder
        self.uploader = Uploader(ring.descriptor.name, ring.descriptor)
        self.reading: Future[tuple[int, bytes]] | None = None
        self._call: Call | None = None

    @property
    def is_busy(self) -> bool:
        """Return whether it waits for the disk or the holder."""
        return bool(self.reading or self._call)

    def handle_call(self, now_s: float) -> None:
        """Process the answer if there is one."""
        call, uploader = self._call, self.uploader
        if call is not None and call.is_done:
            self._call = None
            if call.response is not None:
                uploader.handle_response(call.response.payload, self._ring.end, now_s)
            else:
                is_silent = isinstance(call.error, SessionTimeoutError)
                uploader.handle_failure(str(call.error), now_s, is_silent=is_silent)

    def send_next(self, client: ClientCore, now_s: float, windows: Windows | None, *, is_chosen: bool) -> None:
        """Send the next request if none is under way, as of ``Uploader``."""
        reading, uploader, ring = self.reading, self.uploader, self._ring
        if reading is not None and reading.done():
            self.reading = None
            try:
                offset, data = reading.result()
            except GdpError as error:
                uploader.handle_failure(str(error), now_s)
            else:
                self._call = _asked(client, uploader.append(offset, data), now_s)
        wanted = uploader.next_step(ring.begin, ring.end, now_s, windows, is_chosen=is_chosen)
        if isinstance(wanted, HolderRequest):
            self._call = _asked(client, wanted, now_s)
        elif wanted is not None:
            self.reading = ring.read(wanted.offset, wanted.size)
            if self.reading.done():
                self.send_next(client, now_s, windows, is_chosen=is_chosen)


class KeptCapsule:
    """One capsule, of one topic or several.

    The records go to the holder that has most, and the others fetch them from it: the uplink carries them once.

    Args:
        around_ns: what is kept before and after each mark; None: everything is.

    Attributes:
        publishers: of its topics, as far as they are kept now.
        ring: on the disk here.
        is_superseded: another capsule has its topics now.
        lost: messages that the disk here did not take in time.
    """

    def __init__(
        self,
        ring: CapsuleRing,
        key: Identity,
        holders: Sequence[Name],
        around_ns: tuple[int, int] | None = None,
        *,
        is_superseded: bool = False,
    ) -> None:
        self.publishers: dict[Name, Publisher] = {}
        self.ring = ring
        self.is_superseded = is_superseded
        self.name = ring.descriptor.name
        self._writer = ChainWriter(ring.chain, key.key)
        self._uploads = [_Upload(ring, holder) for holder in holders]
        self._chosen = self._uploads[0]
        self._windows = None if around_ns is None else ring.windows(*around_ns)
        self._mark = ring.mark  # number of the record of the last one
        self._marked: dict[str, int] = {}  # when each name was marked last, within a second
        self._waiting = deque[_Waiting]()
        self._waiting_bytes = 0
        self._described: dict[Name, list[bytes]] = {}  # frames of each topic's latest description in the ring
        self._describes: set[Name] = set()  # topics whose description is repeated before the next message
        self.lost = self._reported = 0

    def add(self, topic: Name, publisher: Publisher) -> None:
        """Keep what a publisher of one of the topics publishes from now on."""
        self.publishers[topic] = publisher
        publisher.record(partial(self._record, topic), partial(self._describe, topic))

    @property
    def uploader(self) -> Uploader:
        """Return that to the holder which gets the records."""
        return self._chosen.uploader

    @property
    def confirmed(self) -> tuple[int, ...]:
        """Return how many bytes each holder has, as it confirmed."""
        return tuple(each.uploader.confirmed for each in self._uploads)

    @property
    def is_busy(self) -> bool:
        """Return whether something waits for the disk or a holder."""
        return bool(self._waiting) or not self.ring.is_written or any(each.is_busy for each in self._uploads)

    def flush(self, time_ns: int) -> None:
        """Append what was sealed to the ring, with checkpoints where they are due."""
        self._seal_recorded()
        pieces, windows = list[bytes](), self._windows
        while self.ring.is_ready and (self._waiting or self._is_due(time_ns)):
            if self._waiting and not self._writer.is_due(time_ns):
                each = self._waiting.popleft()
                frames = [frame for sealed in each.frames for frame in sealed[:]]
                self._waiting_bytes -= each.size_bytes
                if each.topic is not None and each.type is RecordType.DESCRIPTION:
                    self._described[each.topic] = frames
                    self._describes.discard(each.topic)
                elif each.topic in self._describes:
                    pieces.append(self._writer.append(RecordType.DESCRIPTION, time_ns, self._described[each.topic]))
                    self._describes.remove(each.topic)
                elif each.mark is not None:
                    frames = [each.mark._replace(previous=self._mark).to_bytes(), *frames]
                    self._mark = self._writer.chain.number
                pieces.append(self._writer.append(each.type, time_ns, frames, each.sequence, each.messages))
                continue
            begins_file = self.ring.wants_file
            self._append(pieces)
            at, pieces = Place(self.ring.next, self._writer.chain.number, time_ns), []
            self.ring.append(self._writer.checkpoint(time_ns), begins_file=begins_file)
            if windows is not None:
                if windows.is_due(time_ns) and not self._waiting:
                    windows.close(self.ring.next)
                windows.add_checkpoint(at)
                self.ring.trim(windows.drop(min(self.confirmed)))
            if begins_file or windows is not None:
                self._describes |= (
                    self._described.keys()
                )  # what is before may be left out or dropped, and these with it
        self._append(pieces)

    def _is_due(self, time_ns: int) -> bool:
        return self._writer.is_due(time_ns) or (self._windows is not None and self._windows.is_due(time_ns))

    def mark(self, name: str, time_ns: int) -> None:
        """Mark an event, and open a window around it; one that repeats within a second extends its window alone.

        Raises:
            StoreError: the disk takes no records now.
        """
        self.flush(time_ns)
        if not self.ring.is_ready:
            raise StoreError(f"{name} is not marked: {self.ring.failure or 'the disk is too slow'}")
        mark = Mark(0, time_ns, time_ns, 0) if self._windows is None else self._windows.mark(time_ns)
        recorders, last_ns = [each.queue.recorder for each in self.publishers.values()], self._marked.get(name)
        if last_ns is not None and time_ns - last_ns < CHECKPOINT_NS:
            return
        self._marked = {each: at_ns for each, at_ns in self._marked.items() if time_ns - at_ns < CHECKPOINT_NS}
        self._marked[name] = time_ns
        sealed = tuple([each.seal_mark(name, time_ns) for each in recorders if each is not None])
        self._wait(_Waiting(RecordType.MARK, None, sealed, mark=mark))
        self.flush(time_ns)

    def _append(self, pieces: list[bytes]) -> None:
        if pieces:
            self.ring.append(b"".join(pieces), begins_file=False)

    def upload(self, clients: Mapping[Name, ClientCore], now_s: float) -> None:
        """Send the next requests where none is under way."""
        for each in self._uploads:
            each.handle_call(now_s)
        if not self._chosen.is_busy:
            ready = [each for each in self._uploads if not each.uploader.is_refused] or self._uploads
            self._chosen = max(ready, key=lambda each: (each.uploader.confirmed, each is self._chosen))
        for each in self._uploads:
            each.send_next(clients[each.holder], now_s, self._windows, is_chosen=each is self._chosen)

    @property
    def is_reading(self) -> bool:
        """Return whether the disk is read for the next request."""
        return self._chosen.reading is not None

    @property
    def is_uploaded(self) -> bool:
        """Return whether every holder has confirmed all that was published; of windows, all that stands in one."""
        self._seal_recorded()
        confirmed, end, windows = min(self.confirmed), self.ring.end, self._windows
        is_whole = confirmed == end if windows is None else windows.next(max(confirmed, self.ring.begin), end) is None
        return is_whole and not self.is_busy

    @property
    def is_whole(self) -> bool:
        """Return whether it is uploaded, and nothing of it was lost before."""
        return self.is_uploaded and not self.lost and not any(each.uploader.missing_bytes for each in self._uploads)

    def poll_faults(self) -> list[str]:
        """Return, once, what went wrong: what a holder refused or never had, and messages that are not kept."""
        faults = [each for upload in self._uploads for each in upload.uploader.poll_faults()]
        if len(self._uploads) > 1:
            have = sum(each >= max(self.confirmed) for each in self.confirmed)
            faults = [f"{have} of {len(self._uploads)} holders have it: {each}" for each in faults]
        lost, self._reported = self.lost - self._reported, self.lost
        why = self.ring.failure or "the disk is too slow"
        return [*faults, f"{lost} messages are not kept: {why}"] if lost else faults

    def finish(self, time_ns: int) -> None:
        """Append what was published so far, with a checkpoint over it; the publishers end."""
        self.flush(time_ns)
        if self._writer.has_new and self.ring.is_ready:
            self._append([self._writer.checkpoint(time_ns)])

    def supersede(self, time_ns: int) -> None:
        """Finish it, since another capsule has its topics now; without a message it stays as it is."""
        self._seal_recorded()
        if self.ring.next or any(each.type is RecordType.MESSAGE for each in self._waiting):
            self.finish(time_ns)
        self.is_superseded = True

    def _seal_recorded(self) -> None:
        for each in self.publishers.values():
            each.seal_recorded()

    def _record(self, topic: Name, frames: Sealed, sequence: int, messages: int) -> None:
        if self._waiting_bytes + frames.size_bytes > WINDOW_BYTES:
            self.lost += messages
            return
        self._wait(_Waiting(RecordType.MESSAGE, topic, (frames,), sequence, messages))

    def _describe(self, topic: Name, frames: Sealed, _sequence: int, _messages: int) -> None:
        self._wait(_Waiting(RecordType.DESCRIPTION, topic, (frames,)))

    def _wait(self, waiting: _Waiting) -> None:
        self._waiting_bytes += waiting.size_bytes
        self._waiting.append(waiting)


class CapsuleKeeper:
    """Keeper of the topics of one node.

    Args:
        folder: of the rings.
        start: number of the first call, random in 64 bits.
        pool: one thread; None: of its own.

    Attributes:
        topics: the capsule of each topic that is kept.
        ended: capsules that are continued no more, and not yet uploaded, by name.
    """

    def __init__(
        self, member: Participant, identity: Identity, folder: Path, *, start: int, pool: Executor | None = None
    ) -> None:
        self._member = member
        self._identity = identity
        self._folder = folder
        self._start = start
        self._pool = ThreadPoolExecutor(1, "capsules") if pool is None else pool
        self._clients: dict[Name, ClientCore] = {}
        self._by_folder: dict[Path, KeptCapsule] = {}
        self.topics: dict[Name, KeptCapsule] = {}
        self.ended: dict[Name, KeptCapsule] = {}
        self._due_s = 0.0

    def keep(
        self,
        topic: Topic,
        publisher: Publisher,
        holders: Sequence[Topic],
        most_bytes: int,
        unix_s: float,
        around_ns: tuple[int, int] | None = None,
        capsule: str | None = None,
    ) -> KeptCapsule:
        """Keep what a publisher publishes from now on.

        Args:
            holders: the delegations to call the holders' services, the preferred one first.
            most_bytes: of the ring.
            around_ns: as of ``KeptCapsule``.
            capsule: topics of one label share a capsule; None: it has one of its own. The first topic's values count.

        Raises:
            GdpError: no delegation, too many topics, or the folder cannot be read or written.
        """
        folder = self._folder / (capsule or topic.name.to_text())
        kept = self._by_folder.get(folder)
        if kept is None or topic.name not in kept.ring.descriptor.topics:
            names = [holder.name for holder in holders]
            kept = self._begin(folder, kept, topic, unix_s, most_bytes, names, around_ns)
            for holder in holders:
                self.client(holder)
        kept.add(topic.name, publisher)
        self.topics[topic.name] = kept
        log.info("topic kept name=%s capsule=%s", topic.name.short, kept.name.short)
        return kept

    def _begin(
        self,
        folder: Path,
        before: KeptCapsule | None,
        topic: Topic,
        unix_s: float,
        most_bytes: int,
        holders: Sequence[Name],
        around_ns: tuple[int, int] | None,
    ) -> KeptCapsule:
        """Begin or continue the capsule in a folder that has a topic, and those of the one before."""
        right, begun_ms = TopicRight(topic.delegation.subject, topic.delegation.chain), int(unix_s * 1e3)
        rights = [right] if before is None else [*before.ring.descriptor.rights, right]
        if len(rights) > TOPICS_MAX:
            raise LocalError(f"keep: more than {TOPICS_MAX} topics in capsule {folder.name}; use several")
        if before is not None:
            begun_ms = max(begun_ms, before.ring.descriptor.begun_ms + 1)
            before.supersede(int(unix_s * 1e9))
            if before.ring.next:
                self.ended[before.name] = before
            else:
                before.ring.remove()
        descriptor = Descriptor.of_topics(rights, self._identity.membership, begun_ms)
        for name, each in list(self.ended.items()):
            if each.ring.continues(folder, descriptor):
                self.ended.pop(name).ring.close()
        ring = CapsuleRing(folder, descriptor, most_bytes, self._pool)
        kept = self._by_folder[folder] = KeptCapsule(ring, self._identity, holders, around_ns)
        for old in ring.older(self.ended):
            self.ended[old.descriptor.name] = KeptCapsule(old, self._identity, holders, around_ns, is_superseded=True)
        if before is not None:
            for name, publisher in before.publishers.items():
                kept.add(name, publisher)
                self.topics[name] = kept
            before.publishers = {}
        return kept

    def client(self, holder: Topic) -> ClientCore:
        """Return the client of a holder's service. Raises ``LocalError``: no delegation."""
        client = self._clients.get(holder.name)
        if client is None:
            label = f"holder {holder.name.short}"
            client = ClientCore(self._member, holder, label, start=self._start, options=_BACKGROUND)
            self._clients[holder.name] = client
        return client

    def release(self, topic: Name, unix_s: float) -> None:
        """Keep a topic no more; what waits is uploaded. Its capsule is continued when it is kept again."""
        kept = self.topics.pop(topic, None)
        if kept is not None:
            kept.finish(int(unix_s * 1e9))
            del kept.publishers[topic]
            if not kept.publishers:
                del self._by_folder[kept.ring.folder]
                self.ended[kept.name] = kept

    def is_asked(self, name: Name) -> bool:
        """Return whether a name is the service of a holder."""
        return name in self._clients

    def receive(self, message: Message, now_s: float) -> None:
        """Process a message of a holder. Raises ``RemoteError``: it is malformed."""
        self._clients[message.topic].receive(message, now_s)

    def handle(self, now: Timestamps) -> None:
        """Write and upload what is there, and handle the timers that are due."""
        if not self._clients:
            return  # nothing is kept yet, and no holder asked
        if now.mono_s >= self._due_s:
            self.flush(now.unix_s)
            is_busy = bool(self.ended) or any(each.is_busy for each in self.capsules)
            self._due_s = now.mono_s + (PACE_S if is_busy else TICK_S)
        for client in self._clients.values():
            due_s = client.get_timer()
            if due_s is not None and now.mono_s >= due_s:
                client.handle_timer(now.mono_s)
        for kept in self.capsules:
            kept.upload(self._clients, now.mono_s)
            if kept.is_reading:
                self._due_s = min(self._due_s, now.mono_s + SCHEDULED_S)
        for name in [name for name, kept in self.ended.items() if kept.is_uploaded]:
            kept = self.ended.pop(name)
            if kept.is_superseded:
                kept.ring.remove()
            else:
                kept.ring.close()

    def flush(self, unix_s: float) -> None:
        """Append what was published so far, for ``is_uploaded``."""
        for kept in self.capsules:
            kept.flush(int(unix_s * 1e9))

    def has_path(self, now_s: float) -> bool:
        """Return whether a path leads to one of the holders."""
        paths = (each.path(now_s) for each in self._clients.values())
        return any(path is not None and path.cost < COST_UNREACHABLE for path in paths)

    @property
    def is_uploaded(self) -> bool:
        """Return whether the holders have confirmed all that was flushed."""
        return all(each.is_uploaded for each in self.capsules)

    @property
    def confirmed(self) -> int:
        """Return how many bytes the holders have confirmed."""
        return sum(sum(each.confirmed) for each in self.capsules)

    @property
    def capsules(self) -> list[KeptCapsule]:
        """Return those that are continued, and those that are not yet uploaded."""
        return [*self._by_folder.values(), *self.ended.values()]

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        due_s = self._due_s if self.topics or self.ended else None
        return earliest(due_s, *[each.get_timer() for each in self._clients.values()])

    def close(self, unix_s: float) -> None:
        """Put everything on the disk."""
        for topic in list(self.topics):
            self.release(topic, unix_s)
        for kept in self.ended.values():
            kept.ring.close()
        self._pool.shutdown()
