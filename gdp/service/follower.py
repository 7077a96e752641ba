"""Follower: a replica of a service with state, which applies one log's entries in order, one at a time, each once.

Sans-I/O; ``poll_effects`` returns what to do.

The server does one operation at a time: it applies an entry, saves a snapshot, or loads one. Other work waits
meanwhile. Where an operation fails, the server's state is unknown until it loads a snapshot or restarts.
"""

from __future__ import annotations

from enum import Enum
from typing import Final, NamedTuple, TypeAlias

from gdp.names import Name
from gdp.service.replication_messages import (
    NO_LOG,
    AttachReplica,
    FollowerMessage,
    LogId,
    ReplicaProbe,
    ReplicaStatus,
    Snapshot,
    SnapshotRequest,
    place_of,
)

HELD_MAX: Final = 1_024  # how far ahead of its server it accepts entries
HELD_MAX_BYTES: Final = 64 << 20
UNKEPT: Final = "this service takes requests in order, and follows no sequencer yet"


class Apply(NamedTuple):
    """Apply an entry at the server."""

    client: Name
    call: int
    request: bytes


class Fetch(NamedTuple):
    """Read the server's state."""


class Load(NamedTuple):
    """Write the server's state."""

    state: bytes


class Say(NamedTuple):
    """Send a client a message."""

    client: Name
    word: FollowerMessage


class Refuse(NamedTuple):
    """Fail a client's request."""

    client: Name
    call: int
    reason: str


Effect: TypeAlias = "Apply | Fetch | Load | Say | Refuse"


class Doing(Enum):
    """What the server is doing."""

    NOTHING = "nothing"
    APPLYING = "applying"
    TELLING = "telling"
    LOADING = "loading"


class Follower:
    """The position and pending work of one server.

    Args:
        tells: whether its state can be read and written.

    Attributes:
        sequencer: the sequencer whose log it follows.
    """

    def __init__(self, *, tells: bool) -> None:
        self._tells = tells
        self._can_tell = tells
        self._log = NO_LOG
        self._index = 0
        self._is_lost = False
        self.sequencer: Name | None = None
        self._held: dict[int, tuple[int, bytes]] = {}  # index -> call and request; of this log, not applied yet
        self._held_bytes = 0
        self._reported_gap = -1
        self._follow: AttachReplica | None = None  # with a snapshot that waits, or is being loaded
        self._asked_state = False
        self._effects: list[Effect] = []
        self.doing = Doing.NOTHING

    def poll_effects(self) -> list[Effect]:
        """Return, once, what to do, in order."""
        effects, self._effects = self._effects, []
        return effects

    def handle_message(self, client: Name, word: ReplicaProbe | AttachReplica | SnapshotRequest) -> None:
        """Handle a sequencer's message."""
        if isinstance(word, ReplicaProbe):
            if client == self.sequencer and word.incarnation_id != self._log.incarnation_id and self._follow is None:
                self.sequencer = None  # the sequencer keeps this log no more
            if self._follow is None or client != self.sequencer:
                self._say(client)
        elif isinstance(word, AttachReplica):
            self._take_follow(client, word)
        elif client != self.sequencer or word.log != self._log or not self._can_tell or self._is_lost:
            self._effects.append(Say(client, Snapshot(word.log, 0, None)))
        else:
            self._asked_state = True
        self._go_on()

    def entry(self, client: Name, call: int, request: bytes) -> None:
        """Handle an entry, or a request that a client sent as one."""
        incarnation_id, index = place_of(call)
        if client != self.sequencer:
            reason = UNKEPT if self.sequencer is None else f"kept in order by {self.sequencer.short}"
            self._effects.append(Refuse(client, call, reason))
            return
        if incarnation_id != self._log.incarnation_id or self._is_lost or index <= self._index or index in self._held:
            return  # of a log that is over or unknown here, or a duplicate
        if index > self._index + HELD_MAX:
            return  # the sequencer detects that it is not applied, and sends it again
        if index > self._index + 1 and self._held_bytes + len(request) > HELD_MAX_BYTES:
            return  # likewise; the next entry always fits
        self._held[index] = call, request
        self._held_bytes += len(request)
        self._go_on()
        reach = self._reach()
        if index > reach and self._reported_gap != reach:
            self._reported_gap = reach
            self._say(client)

    def applied(self) -> None:
        """Record that the server has applied the entry."""
        self._end(Doing.APPLYING)
        self._index += 1
        self._held_bytes -= len(self._held.pop(self._index)[1])
        self._go_on()

    def failed(self) -> None:
        """Record that the server failed at the entry: whether it has applied it is not known."""
        self._end(Doing.APPLYING)
        self._lose()
        self._go_on()

    def receive_state(self, state: bytes | None) -> None:
        """Handle the server's state; None: it has none."""
        self._end(Doing.TELLING)
        self._asked_state = False
        self._can_tell = self._can_tell and state is not None
        if self.sequencer is not None:
            self._effects.append(Say(self.sequencer, Snapshot(self._log, self._index, state)))
        self._go_on()

    def loaded(self, *, is_done: bool) -> None:
        """Record whether the server has loaded the state."""
        self._end(Doing.LOADING)
        follow, self._follow = self._follow, None
        if follow is None:
            return
        if is_done:
            self._set_log(follow.log, follow.at)
        else:
            self._can_tell = False
            self._lose()
        self._go_on()

    def renewed(self, *, is_doubtful: bool) -> None:
        """Record that the server restarted; ``is_doubtful``: it may have received an entry since."""
        self.doing = Doing.NOTHING
        self._follow, self._asked_state, self._can_tell = None, False, self._tells
        self._log, self._index, self._is_lost = NO_LOG, 0, is_doubtful
        self._clear()
        if self.sequencer is not None:
            self._say(self.sequencer)

    def sequencer_lost(self) -> None:
        """Record that the sequencer is gone: another may come. Held entries are still applied."""
        self.sequencer = None

    def _take_follow(self, client: Name, word: AttachReplica) -> None:
        if self.sequencer not in {None, client}:
            self._say(client)
        elif self._follow is not None:
            pass  # the sequencer gets a status when the server has loaded its snapshot
        elif word.state is None:
            at = (self._log, self._index) == (word.log_before, word.at_before)
            if at and not self._is_lost and self.doing is Doing.NOTHING:
                self.sequencer = client
                self._set_log(word.log, word.at)
            else:
                self._say(client)
        elif not self._can_tell or word.log < self._log or (word.log == self._log and word.at < self._index):
            self._say(client)
        else:
            self.sequencer, self._follow = client, word
            self._clear()

    def _go_on(self) -> None:
        """Start the server's next operation."""
        if self.doing is not Doing.NOTHING:
            return
        if self._follow is not None and self._follow.state is not None:
            self.doing = Doing.LOADING
            self._effects.append(Load(self._follow.state))
        elif self._asked_state:
            self.doing = Doing.TELLING
            self._effects.append(Fetch())
        elif self._index + 1 in self._held:
            self.doing = Doing.APPLYING
            call, request = self._held[self._index + 1]
            # An entry whose client is gone is applied as well, without a response.
            self._effects.append(Apply(self.sequencer or _ABSENT, call, request))

    def _set_log(self, log: LogId, index: int) -> None:
        """Set the log and the position in it; held entries of this log stay."""
        if log != self._log:
            self._clear()
        self._log, self._index, self._is_lost = log, index, False
        for done in [each for each in self._held if each <= index]:
            self._held_bytes -= len(self._held.pop(done)[1])
        if self.sequencer is not None:
            self._say(self.sequencer)

    def _lose(self) -> None:
        self._log, self._index, self._is_lost = NO_LOG, 0, True
        self._clear()
        if self.sequencer is not None and self._follow is None:
            self._say(self.sequencer)

    def _clear(self) -> None:
        """Discard held entries, except the one that the server is applying."""
        now = self._index + 1
        self._held = {now: self._held[now]} if self.doing is Doing.APPLYING else {}
        self._held_bytes = sum(len(request) for _, request in self._held.values())
        self._reported_gap = -1

    def _end(self, doing: Doing) -> None:
        assert self.doing is doing, f"{self.doing} ended as {doing}"
        self.doing = Doing.NOTHING

    def _reach(self) -> int:
        reach = self._index
        while reach + 1 in self._held:
            reach += 1
        return reach

    def _say(self, client: Name) -> None:
        kept_by = None if self.sequencer in {None, client} else self.sequencer
        said = ReplicaStatus(self._log, self._index, self._reach(), self._is_lost, self._can_tell, kept_by)
        self._effects.append(Say(client, said))


_ABSENT: Final = Name(bytes(32))
