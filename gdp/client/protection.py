"""Protection of one publisher's frames against loss: what is sent again, in addition or by another path, and when.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Sources: docs/explanation/loss.md and two-paths.md.

===========  ==================================================  ======================================================
what         of which frames                                     while
===========  ==================================================  ======================================================
repair       reliable and latched topics                         a reader lacks them (``gdp/message/send_window.py``)
late repair  best effort, messages of three fragments or more    ... and they can be in time (``best_effort_cache.py``)
parity       messages of three fragments or more, one path       loss and round trip are long enough for it to save time
copies       urgent, messages of one or two fragments            loss is measured, or not known (``redundancy.py``)
second path  all                                                 there are two paths
striping     long messages; the others take both paths           there are two paths (``gdp/message/striping.py``)
===========  ==================================================  ======================================================

Within one turn parity that waits leaves first, then repairs, new frames, their parity, and the copies that are due.
Repairs for readers that do not govern leave when nothing new waits.
"""

from __future__ import annotations

from itertools import chain

from gdp.client.best_effort_cache import BestEffortCache
from gdp.client.governing_paths import GoverningPaths
from gdp.client.identities import WriterIdentity
from gdp.client.key_epochs import KeyEpochs
from gdp.client.parity_sender import LOSS_MIN, RTT_MIN_S, ParitySender
from gdp.client.reader_proxies import ReaderProxies
from gdp.client.redundancy import Redundancy
from gdp.client.send_options import PublisherSettings
from gdp.client.send_queue import SendQueue
from gdp.client.sent_frames import SentFrames
from gdp.frame.codec import second_path_copy
from gdp.limits import MTU_MIN_BYTES, SPREAD
from gdp.message.acknack import AckNack
from gdp.message.send_window import SendWindow
from gdp.message.striping import Striper


class Protection:
    """Policy of protection of one publisher.

    Args:
        source: has the budgets of copies and of parity.
        sent_frames: where each frame that leaves is entered.

    Attributes:
        late: large messages of a best-effort topic that may be repaired.
        copies: of urgent frames.
        parity: parity frames of large messages.
        has_more: the last ``poll_frames`` reached its limit.
        entered: changes of the readers when frames were last entered.
    """

    def __init__(
        self,
        *,
        source: WriterIdentity,
        keys: KeyEpochs,
        readers: ReaderProxies,
        queue: SendQueue,
        window: SendWindow,
        paths: GoverningPaths,
        sent_frames: SentFrames,
        settings: PublisherSettings,
    ) -> None:
        self._readers = readers
        self._queue = queue
        self._window = window
        self._paths = paths
        self._sent_frames = sent_frames
        self._has_one_path, self._is_urgent = settings.paths == 1, settings.urgent
        fec = settings.options.is_redundant
        self.late = BestEffortCache(settings.options)
        self.copies = Redundancy(budget=source.copies, is_enabled=self._is_urgent and fec)
        self.parity = ParitySender(keys=keys, budget=source.parity, is_enabled=self._has_one_path and fec)
        self._striper = Striper() if settings.paths == SPREAD else None
        self._loss: float | None = None  # of frames, where parity may save time
        self.entered = -1
        self.has_more = False

    @property
    def repairs(self) -> int:
        """Return how many fragments were sent again because a reader lacked them."""
        return self._window.retransmissions + self.late.retransmissions

    def set_options(self) -> None:
        """Follow the options of the queue, which have changed."""
        options = self._queue.options
        self.copies.is_enabled = self._is_urgent and options.is_redundant
        self.parity.is_enabled = self._has_one_path and options.is_redundant
        self._measure_loss(self._paths.seen_s)
        self.late.set_options(options)

    def handle_report(self, reader: bytes, acknack: AckNack, now_s: float, *, is_new: bool) -> None:
        """Learn from a report what is lost; ``is_new``: the reader, or this incarnation of it, was unknown before."""
        if self._striper is not None:
            self._striper.handle_share(reader, acknack.share)
        if is_new:
            self._sent_frames.loss.forget(reader)
        elif self.copies.is_enabled and acknack.next_number:
            self._sent_frames.loss.handle_report(reader, acknack.next_number, acknack.next_part, acknack.frames)
        if acknack.missing:
            self.parity.handle_report({each.number for each in acknack.missing})
        self._measure_loss(now_s)

    def request_late(self, reader: bytes, acknack: AckNack, now_s: float) -> None:
        """Queue what a reader of a best-effort topic lacks, as far as it can be in time."""
        if acknack.missing and not self._queue.is_acknowledged:
            newest = acknack.newest, acknack.newest_part
            self.late.request(
                reader,
                acknack.missing,
                now_s,
                newest=newest,
                rtt_s=self._paths.paces.rtt_s(reader) or self._paths.rtt_s,
            )

    def poll_frames(self, now_s: float, limit_bytes: int, heartbeats: list[bytes]) -> list[bytes]:
        """Return Heartbeats and about ``limit_bytes`` of other frames, as they leave now; with 0 nothing new does."""
        paths, parity, again = self._paths, self.parity, 0
        is_doubled, self.has_more = not self._has_one_path and paths.is_doubled(now_s), False
        before, sent, after = list[bytes](), list[bytes](), list[bytes]()
        if paths.paces.stated:
            paths.paces.begin_turn()
        if limit_bytes > 0:
            left = limit_bytes // ((self._queue.mtu or MTU_MIN_BYTES) * (2 if is_doubled else 1)) or 1
            if parity.waiting:
                before = parity.poll_frames(left)
                left -= len(before)
            repaired = self._window.retransmissions + self.late.retransmissions
            sent = self._poll_data(now_s, left)
            again = self._window.retransmissions + self.late.retransmissions - repaired
            if self._loss is not None:
                parity.handle_sent(
                    sent,
                    self._loss,
                    paths.capacity_bytes_s,
                    now_s,
                    paths.paces.pace_of_lossy(self._readers.active, LOSS_MIN),
                )
            left -= len(sent)
            self.has_more = left <= 0
            if parity.waiting:
                self.has_more = left <= len(parity.waiting)
                after = parity.poll_frames(max(left, 0))
            if not is_doubled and (sent or self.entered != self._readers.changes):
                self._sent_frames.leaving = sent, paths.confirming(sent, again), now_s, again
                self.entered = self._readers.changes
            if paths.limit_bytes_s is not None:
                paths.charge_limit(chain(before, sent, after), now_s)
        frames = heartbeats + before + sent + after
        if frames:
            self._sent_frames.last_s = now_s
        copies = self._poll_copies(sent, now_s) if self.copies.is_enabled or now_s >= self.copies.due_s else []
        if extra := copies + before + after:  # no reader confirms them
            paths.charge(sum(map(len, extra)), now_s)
        frames += copies
        if self._has_one_path or not paths.has_second(now_s):
            return frames
        if self._striper is None:
            return [*frames, *map(second_path_copy, frames)]
        return self._striper.stripe(frames, len(heartbeats) + again, self._readers.names())

    def _poll_data(self, now_s: float, limit: int) -> list[bytes]:
        """Return at most ``limit`` frames; those that were sent before come first."""
        if limit <= 0:
            return []
        frames = self.late.frames_to_send(now_s, limit) if self.late.messages else []
        left = limit - len(frames) if frames else limit
        if left > 0:
            new = self._queue.frames_to_send(now_s, left)
            if new and not self._queue.is_acknowledged:
                self.late.record_sent(new, now_s)
            frames += new
        if self._window.governing is None or len(frames) >= limit:
            return frames
        most = -(-self._paths.allowance_of_all(now_s) // (self._queue.mtu or MTU_MIN_BYTES))
        return self._window.late_repairs_to_send(now_s, min(limit - len(frames), most)) + frames

    def _poll_copies(self, sent: list[bytes], now_s: float) -> list[bytes]:
        """Queue the copies of urgent frames that leave now, and return those that are due."""
        if sent and self.copies.is_enabled:
            self._sent_frames.loss.handle_sent(sent)
            loss, has_pair = self._measured_loss(now_s), self._paths.has_second(now_s)
            self.copies.handle_sent(sent, loss, self._paths.capacity_bytes_s, now_s, has_pair=has_pair)
        due = self.copies.poll_copies(now_s)
        if due:
            self._sent_frames.loss.handle_sent(due)
        return due

    def _measured_loss(self, now_s: float) -> float | None:
        """Return the share of frames lost on the way to the readers, 0 to 1; None: unknown."""
        measured = self._sent_frames.loss.loss(self._paths.measured_readers(), now_s), self._paths.loss or None
        return max((each for each in measured if each is not None), default=None)

    def _measure_loss(self, now_s: float) -> None:
        """Note whether messages get parity from now on; reports change that, not each poll.

        The round trip of the empty path counts, because a busy machine lengthens the others on any link.
        """
        trip_s = self._paths.base_rtt_s if self.parity.is_enabled else None
        self._loss = self._measured_loss(now_s) if trip_s is not None and trip_s >= RTT_MIN_S else None
        deadline_s = self._queue.options.deadline_s
        self._queue.has_parity = self._loss is not None and self.parity.is_wanted(self._loss, trip_s, deadline_s)
