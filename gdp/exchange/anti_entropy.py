"""Anti-entropy: one node's part in equalising its sets with those of its peers.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: Demers et al., Epidemic algorithms for replicated
database maintenance, 1987, section 1.3. One engine serves each protocol that keeps a set equal at several nodes.

Each node sends its peers the hash over each set, its total. A node that differs fetches: it requests the hashes below
prefixes that differ, and, where it has few items, those that are newer. So bytes are proportional to the difference.
The peer that differs also receives our total, and fetches what it lacks in turn.

::

    total                      ->
                                  (differs) request: prefixes, lines of items  <-
    hashes, newer items, end   ->
                                  request for what lies below those hashes     <-
    hashes, newer items, end   ->

One request is under way for each peer, and one peer for each set. So the slower of both sets the pace. A reply has a
bounded size, there is a pause between two, and a name gets a bounded number of items in a window of time. Nothing is
acknowledged: a fetch that makes no progress is given up, and totals are repeated. The owner of a set verifies the items
and decides what it accepts; items prove themselves.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar

from gdp.exchange.sync_message import ASKED_MAX, CAPACITY_BYTES, LACKING_MAX, SyncMessage, pages
from gdp.exchange.sync_set import FANOUT, HASH_BYTES, LINE_BYTES, PREFIX_MAX_BYTES, SyncSet

_HASHES_BYTES: Final = FANOUT * HASH_BYTES
_FEW: Final = _HASHES_BYTES // LINE_BYTES  # items below a prefix that are listed, or sent; for more, hashes are shorter
_LINES_MAX: Final = 512  # of one prefix in a request
_PREFIX_COST_BYTES: Final = 12  # of a prefix in a request, for the heads of its fields
_EXAMINED_BYTES: Final = 32  # of a reply that an item compared with lines counts for
_HASHES_DRAWN: Final = 4  # items that 256 hashes count for
_WINDOW_S: Final = 600.0
_SPARE: Final = 4_096  # items that a name may draw in a window, in addition to a multiple of all there are
_BARREN: Final = 5  # times ``fetch_s`` after which a fetch that brought nothing new ends
_LONGEST: Final = 100  # times ``fetch_s`` after which any fetch ends, so that other peers have their turn
_REPEATS: Final = 3  # of one request
_NAMES_MAX: Final = 1_024

P = TypeVar("P", bound=Hashable)


@dataclass(frozen=True, slots=True, kw_only=True)
class SyncPace:
    """Times and bounds of one protocol.

    Args:
        total_s: seconds between totals to a peer.
        soon_s: minimum seconds between totals to one name, where a peer is new or differs.
        fetch_s: seconds without progress after which a fetch is given up.
        reply_s, reply_bytes: minimum seconds between two replies to a peer, and size of one, about.
        draws: times that one name may draw all there is in ten minutes.
    """

    total_s: float
    soon_s: float
    fetch_s: float
    reply_s: float
    reply_bytes: int
    draws: int


@dataclass(slots=True)
class _Fetch:
    """What is requested of a peer in one set."""

    of: bytes
    total: bytes  # of the set here, when the fetch began
    begun_s: float
    until_s: float  # without progress
    prefixes: deque[bytes]
    repeats_left: int = _REPEATS
    requested: dict[bytes, None] = field(default_factory=dict)  # now; less those whose hashes came


@dataclass(slots=True)
class _Peer:
    name: bytes
    total_at_s: float
    totals: dict[bytes, bytes] = field(default_factory=dict)  # that it sent, of sets that were not fetched since
    answered_s: float = float("-inf")  # when its totals were answered with ours
    fetch: _Fetch | None = None
    barren_until_s: float = float("-inf")
    request: SyncMessage | None = None  # that waits for its reply
    reply_at_s: float = float("-inf")


@dataclass(slots=True)
class _Drawn:
    """What one name drew in a window of time."""

    since_s: float
    count: int = 0


class AntiEntropy(Generic[P]):
    """Anti-entropy of one node over several sets.

    Args:
        sets: by identifier, up to 32 bytes; the owner may add sets at any time. Keys have up to ``KEY_MAX_BYTES``.
        item_of: returns an item of a set as it is sent, given its key and the monotonic second, or None.

    Attributes:
        compared: sets of which a peer had nothing that this node lacks.
    """

    def __init__(
        self,
        sets: Mapping[bytes, SyncSet[Any]],
        item_of: Callable[[bytes, bytes, float], bytes | None],
        pace: SyncPace,
    ) -> None:
        self._sets = sets
        self._item_of = item_of
        self._pace = pace
        self._peers: dict[P, _Peer] = {}
        self._said_s: dict[bytes, float] = {}  # by name: when it got totals
        self._drawn: dict[bytes, _Drawn] = {}
        self._news: dict[tuple[bytes, bytes], None] = {}
        self._out: list[tuple[P, SyncMessage]] = []
        self._is_moved = True  # something may be due at another time than ``_due_s``
        self._due_s: float | None = None
        self.compared: set[bytes] = set()

    @property
    def peers(self) -> tuple[P, ...]:
        """Return the peers."""
        return tuple(self._peers)

    def add_peer(self, peer: P, name: bytes, now_s: float) -> None:
        """Add a peer, or begin again with one that has restarted; its totals are due.

        Args:
            name: whose bounds it uses; one node may be several peers.
        """
        self._is_moved = True
        self._peers[peer] = _Peer(name, self._soon(name, now_s))

    def remove_peer(self, peer: P) -> None:
        """Forget a peer that is gone, with what was not sent yet."""
        self._is_moved = True
        self._peers.pop(peer, None)
        self._out = [each for each in self._out if each[0] != peer]

    def push(self, of: bytes, key: bytes) -> None:
        """Send an item to all peers at once, and unasked, if its set is among those that are exchanged."""
        if self._peers and of in self._sets:
            self._news[of, key] = None

    def announce(self, now_s: float) -> None:
        """Send totals to all peers now."""
        self._is_moved = True
        for state in self._peers.values():
            state.total_at_s = now_s

    def took(self, peer: P, now_s: float) -> None:
        """Note that an item of a peer was news which was not pushed; the others get totals after a delay."""
        self._is_moved = True
        for other, state in self._peers.items():
            if other != peer:
                state.total_at_s = min(max(state.total_at_s, now_s), now_s + self._pace.fetch_s)
            elif state.fetch is not None:
                state.fetch.until_s = now_s + self._pace.fetch_s

    def receive_message(self, peer: P, message: SyncMessage, now_s: float) -> tuple[bytes, ...]:
        """Handle a peer's message; return the items in it, for the caller to verify and to store."""
        self._is_moved = True
        state = self._peers[peer]
        fetch = state.fetch
        if not message.is_last or (fetch is not None and not self._is_barren(fetch)):
            self._compare(state, message.totals, now_s)  # what a fetch in vain left different stays so
        if fetch is not None and fetch.of == message.of:
            if message.items:
                fetch.until_s = now_s + self._pace.fetch_s
            for prefix, hashes in message.hashes:
                if prefix in fetch.requested:
                    del fetch.requested[prefix]
                    fetch.until_s = now_s + self._pace.fetch_s
                    fetch.prefixes.extendleft(reversed(self._sets[fetch.of].lacking(prefix, hashes)))
            if message.is_last:
                self._reply_ended(peer, state, fetch, message.rest, now_s)
        if message.asked or message.lacking:
            state.request = message
        self._begin(now_s)
        return message.items

    def handle_timer(self, now_s: float) -> None:
        """Send totals and replies that are due; give up fetches without progress."""
        if (due_s := self.get_timer()) is None or now_s < due_s:
            return
        self._is_moved = True
        for peer, state in self._peers.items():
            fetch = state.fetch
            if fetch is not None and self._end_of(fetch) <= now_s:
                self._repeat(peer, state, fetch, now_s)
            if state.request is not None and state.reply_at_s <= now_s:
                self._reply(peer, state, state.request, now_s)
            if state.total_at_s <= now_s:
                self._send_totals(peer, state, now_s)
        self._begin(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if self._is_moved:
            self._due_s, self._is_moved = self._find_next(), False
        return self._due_s

    def _find_next(self) -> float | None:
        times: list[float] = []
        fetched = self._fetched()
        for state in self._peers.values():
            times.append(state.total_at_s)
            if state.request is not None:
                times.append(state.reply_at_s)
            if state.fetch is not None:
                times.append(self._end_of(state.fetch))
            elif state.totals and not state.totals.keys() <= fetched:
                times.append(state.barren_until_s)
        return min(times, default=None)

    def poll_messages(self, now_s: float) -> list[tuple[P, SyncMessage]]:
        """Return, once, the messages to send, each with its peer."""
        if not (self._news or self._out):
            return []
        for of in dict.fromkeys(of for of, _ in self._news):
            items = (self._item_of(of, key, now_s) for its, key in self._news if its == of)
            for page in pages(item for item in items if item is not None):
                message = SyncMessage(of=of, items=page)
                self._out += [(peer, message) for peer in self._peers]
        self._news.clear()
        out, self._out = self._out, []
        return out

    # -- what the peer has

    def _compare(self, state: _Peer, totals: Iterable[tuple[bytes, bytes]], now_s: float) -> None:
        """Note which sets differ, and let the peer compare ours."""
        for of, total in totals:
            own = self._sets.get(of)
            if own is None:
                continue
            is_equal = own.total == total
            if is_equal or not any(total):
                self.compared.add(of)
                state.totals.pop(of, None)
            else:
                state.totals[of] = total
            if not is_equal and now_s - state.answered_s >= self._pace.fetch_s:
                state.answered_s = now_s
                state.total_at_s = min(state.total_at_s, self._soon(state.name, now_s))

    def _begin(self, now_s: float) -> None:
        """Fetch what differs: of each peer one set at a time, and each set of one peer at a time."""
        fetched = self._fetched()
        for peer, state in self._peers.items():
            if not state.totals or state.fetch is not None or now_s < state.barren_until_s:
                continue
            for of, total in list(state.totals.items()):
                if of in fetched:
                    continue
                del state.totals[of]
                own = self._sets[of].total
                if own != total:
                    state.fetch = _Fetch(of, own, now_s, now_s + self._pace.fetch_s, deque([b""]))
                    self._request(peer, state.fetch, now_s)
                    fetched.add(of)
                    break

    def _fetched(self) -> set[bytes]:
        return {state.fetch.of for state in self._peers.values() if state.fetch is not None}

    def _request(self, peer: P, fetch: _Fetch, now_s: float) -> None:
        """Request what is next: hashes where many items are, what is newer elsewhere."""
        own = self._sets[fetch.of]
        asked: list[bytes] = []
        lacking: list[tuple[bytes, bytes]] = []
        left = CAPACITY_BYTES
        while fetch.prefixes and len(asked) < ASKED_MAX and len(lacking) < LACKING_MAX:
            prefix = fetch.prefixes.popleft()
            count = own.count(prefix)
            if len(prefix) < PREFIX_MAX_BYTES and count > _FEW:
                asked.append(prefix)
                left -= _PREFIX_COST_BYTES
            elif count > _LINES_MAX:  # keys that were made to lie together
                fetch.prefixes.extendleft(prefix + bytes([each]) for each in reversed(range(FANOUT)))
            elif count * LINE_BYTES + len(prefix) + _PREFIX_COST_BYTES <= left:
                lacking.append((prefix, own.lines(prefix)))
                left -= count * LINE_BYTES + len(prefix) + _PREFIX_COST_BYTES
            else:
                fetch.prefixes.appendleft(prefix)
                break
        fetch.requested = dict.fromkeys((*asked, *(prefix for prefix, _ in lacking)))
        fetch.until_s = now_s + self._pace.fetch_s
        self._out.append((peer, SyncMessage(of=fetch.of, asked=tuple(asked), lacking=tuple(lacking))))

    def _repeat(self, peer: P, state: _Peer, fetch: _Fetch, now_s: float) -> None:
        """Repeat a request without a reply, a few times."""
        if fetch.repeats_left and now_s < self._limit_of(fetch):
            fetch.repeats_left -= 1
            fetch.prefixes.extendleft(reversed(fetch.requested))
            self._request(peer, fetch, now_s)
            return
        self._end_fetch(state, fetch, now_s)
        state.total_at_s = min(state.total_at_s, now_s)  # a peer that differs answers with its own

    def _reply_ended(self, peer: P, state: _Peer, fetch: _Fetch, rest: int, now_s: float) -> None:
        fetch.repeats_left = _REPEATS
        left = list(fetch.requested)[-rest:] if rest else []
        fetch.prefixes.extendleft(reversed(left))
        if fetch.prefixes:
            self._request(peer, fetch, now_s)
            return
        self.compared.add(fetch.of)
        self._end_fetch(state, fetch, now_s)

    def _end_fetch(self, state: _Peer, fetch: _Fetch, now_s: float) -> None:
        state.fetch = None
        if self._is_barren(fetch):
            state.totals.pop(fetch.of, None)
            state.barren_until_s = now_s + self._pace.fetch_s

    def _end_of(self, fetch: _Fetch) -> float:
        return min(fetch.until_s, self._limit_of(fetch))

    def _limit_of(self, fetch: _Fetch) -> float:
        return fetch.begun_s + (_BARREN if self._is_barren(fetch) else _LONGEST) * self._pace.fetch_s

    def _is_barren(self, fetch: _Fetch) -> bool:
        """Return whether the peer had nothing for us so far, whatever its totals say."""
        return self._sets[fetch.of].total == fetch.total

    # -- what is here

    def _reply(self, peer: P, state: _Peer, request: SyncMessage, now_s: float) -> None:
        """Send hashes and items up to the size of a reply, and how many prefixes of the request are left."""
        state.request, state.reply_at_s = None, now_s + self._pace.reply_s
        own = self._sets.get(request.of)
        if own is None:
            return
        hashes = list(request.asked)
        items: list[bytes] = []
        left = self._pace.reply_bytes - len(hashes) * _HASHES_BYTES
        rest = len(request.lacking)
        for prefix, lines in request.lacking:
            if left <= 0:
                break
            rest -= 1
            if len(prefix) < PREFIX_MAX_BYTES and own.count(prefix) > _FEW:
                hashes.append(prefix)
                left -= _HASHES_BYTES
                continue
            for key in own.newer(prefix, lines):
                if left <= 0:
                    rest += 1  # the peer requests it again, with lines of what it got
                    break
                item = self._item_of(request.of, key, now_s)
                if item is not None:
                    items.append(item)
                    left -= len(item)
            left -= own.count(prefix) * _EXAMINED_BYTES if lines else 0
        if not self._may_draw(state.name, len(items) + _HASHES_DRAWN * len(hashes), now_s):
            return
        at_once = CAPACITY_BYTES // _HASHES_BYTES
        for at in range(0, len(hashes), at_once):
            page = tuple((prefix, own.hashes(prefix)) for prefix in hashes[at : at + at_once])
            self._out.append((peer, SyncMessage(of=request.of, hashes=page)))
        self._out += [(peer, SyncMessage(of=request.of, items=page)) for page in pages(items)]
        totals = ((request.of, own.total),)
        self._out.append((peer, SyncMessage(of=request.of, totals=totals, is_last=True, rest=rest)))

    def _soon(self, name: bytes, now_s: float) -> float:
        return max(now_s, self._said_s.get(name, float("-inf")) + self._pace.soon_s)

    def _send_totals(self, peer: P, state: _Peer, now_s: float) -> None:
        state.total_at_s = now_s + self._pace.total_s
        _remember(self._said_s, state.name, now_s)
        self._out.append((peer, SyncMessage(totals=tuple((of, each.total) for of, each in self._sets.items()))))

    def _may_draw(self, name: bytes, count: int, now_s: float) -> bool:
        drawn = self._drawn.get(name)
        if drawn is None or now_s - drawn.since_s >= _WINDOW_S:
            drawn = _Drawn(now_s)
            _remember(self._drawn, name, drawn)
        drawn.count += count
        return drawn.count <= self._pace.draws * sum(map(len, self._sets.values())) + _SPARE


def _remember(table: dict[bytes, Any], name: bytes, value: object) -> None:
    """Note something of a name; of too many names, the one of the oldest note is forgotten."""
    table.pop(name, None)
    table[name] = value
    if len(table) > _NAMES_MAX:
        del table[next(iter(table))]
