"""The log of one service that keeps state, at its client: every request goes to all replicas in one order.

Place: pure; time comes in as ``now_s`` (monotonic seconds), randomness as ``life``; what is to be sent comes out of
``take``. It stands where a ``Dispatch`` stands for services without state, with the same methods.

    collecting: asks every replica where it is   --COLLECT_S after the last one came-->   keeping
    keeping: entries go to all that follow       --one has followed a greater log-->      collecting; all calls fail

The log begins from the replica that is furthest, and of these the one with the least name: of two clients that begin at
once one gets it. The others get its state; without states that can be told, only those follow that were where it was.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final, Generic, TypeAlias, TypeVar

from gdp.errors import LocalError
from gdp.names import Name
from gdp.service.dispatch import Ask, Failure
from gdp.service.entries import Entries
from gdp.service.ordered import (
    LIFE_BITS,
    NO_LOG,
    Follow,
    FollowerWord,
    Keep,
    Log,
    Position,
    State,
    Tell,
    Word,
    call_of,
    place_of,
)
from gdp.service.pending import Pending
from gdp.service.replicas import Replica, Replicas

__all__ = ["Effect", "Keeper"]

A = TypeVar("A")

WINDOW: Final = 256  # entries sent to one replica ahead of what it has done
GENERATION_MAX: Final = 1 << 63  # no log comes so far; the next one must still fit into 64 bits
COLLECT_S: Final = 1.0  # after the last replica came, before the log begins without those that are silent
AGAIN_S: Final = 0.25  # between questions to one that does not follow
STALL_S: Final = 1.0  # without progress of one that follows, before it is asked
SILENT_S: Final = 10.0  # for one that has a state to take on, or to tell
_UNLIKE: Final = "its state differs from the others', and theirs cannot be told to it"
_UNKNOWN: Final = "what state its server is in is not known; start it anew"


Effect: TypeAlias = "Ask | Word"


class Keeper(Generic[A]):
    """The calls of one service from here, and the log of them.

    Args:
        life: returns 32 random bits.
        entries: returns an empty log.

    Attributes:
        late: answers that came for a call that had ended: those of all replicas but the first.
        strange: answers of replicas that do not follow.
        hedged: none; every replica gets everything.
    """

    def __init__(
        self,
        *,
        life: Callable[[], int],
        entries: Callable[[], Entries] = Entries,
    ) -> None:
        self._life = life
        self._new_entries = entries
        self._replicas = Replicas()
        self._effects: list[Effect] = []
        self._collect_until_s = 0.0
        self._kept_by: Name | None = None
        self._begin_anew()
        self.late = 0
        self.strange = 0
        self.hedged = 0

    def _begin_anew(self) -> None:
        """Forget the log; nobody follows it."""
        self._log = Log(0, self._life() or 1)
        self._calls = Pending[A](call_of(self._log, 1))
        self._entries = self._new_entries()
        self._state_asked: Name | None = None
        self._state_until_s = 0.0
        self._base = (NO_LOG, 0)  # where a replica was that is where the log begins
        self._is_keeping = False
        self._is_sent = False  # an entry of it
        for replica in self._replicas.values():
            replica.begin_anew()

    def __len__(self) -> int:
        return len(self._calls)

    def __contains__(self, number: int) -> bool:
        life, index = place_of(number)
        return life == self._log.life and index in self._entries

    @property
    def log(self) -> Log:
        """Return which log it keeps; of generation 0 before it begins."""
        return self._log

    @property
    def servers(self) -> list[Name]:
        """Return the replicas that are there."""
        return list(self._replicas)

    @property
    def outside(self) -> Mapping[Name, str]:
        """Return the replicas that cannot follow, and why."""
        return {name: replica.why_not for name, replica in self._replicas.items() if replica.why_not}

    def begin(
        self,
        now_s: float,
        write: Callable[[int], bytes],
        timeout_s: float | None,
        answered: Callable[[A], None],
        failed: Callable[[Failure, str], None],
        first: Sequence[Name] = (),
    ) -> int:
        """Append a request to the log; return its number. One of the callbacks is called, once, and never from here.

        A call that fails may have been applied all the same, or be applied later; one that raises is not.

        Raises:
            LocalError: there is no replica, another keeps this service in order, or the log is full.
        """
        assert not first
        if not self._replicas:
            raise LocalError("no server is there")
        if self._kept_by is not None:
            raise LocalError(f"kept in order by {self._kept_by.short}")
        if self._entries.is_full:
            raise LocalError(f"the log is full: {len(self._entries)} requests, and no state that stands for them")
        if self._entries.last + 1 >> LIFE_BITS:
            raise LocalError("the log is at its end; start this proxy anew")
        number = self._calls.begin(now_s, timeout_s, answered, failed)
        request = write(number)
        self._entries.append(request)
        last = self._entries.last
        if any(self._is_ready(replica) for replica in self._replicas.values()):
            self._effects.append(Ask(number, request, None))
            self._is_sent = True
        for server, replica in self._replicas.items():
            if self._is_ready(replica) and replica.sent == last - 1:
                replica.sent = last
                if replica.position is not None and replica.position.at == last - 1:
                    replica.quiet_until_s = now_s + STALL_S
            self._feed(server, replica)
        self._keep_small(now_s)
        return number

    def came(self, server: Name, now_s: float) -> None:
        """Learn of a replica."""
        if server not in self._replicas:
            self._replicas[server] = Replica(0.0)
            self._collect_until_s = now_s + COLLECT_S
            self._look(now_s)

    def leaves(self, server: Name) -> None:
        """Learn that a replica goes soon: where others follow it is let go."""
        if any(replica.follows for name, replica in self._replicas.items() if name != server):
            self._let_go(server)

    def gone(self, server: Name, now_s: float, reason: str) -> None:
        """Learn that a replica is no more. Calls wait on, for the log reaches whoever comes."""
        del reason
        self._let_go(server)
        self._look(now_s)

    def positioned(self, server: Name, word: FollowerWord, now_s: float) -> None:
        """Take a replica's word about itself."""
        replica = self._replicas.get(server)
        if replica is None or word.log.generation >= GENERATION_MAX:
            self.strange += 1
        elif isinstance(word, State):
            self._take_state(server, replica, word, now_s)
        else:
            self._take_position(server, replica, word, now_s)
        self._look(now_s)

    def answered(self, number: int, server: Name, answer: A, now_s: float) -> None:
        """Take a replica's answer: it has done everything up to there."""
        replica = self._done(number, server, now_s)
        if replica is None:
            self.strange += 1
        else:
            self.late += not self._calls.answer(number, answer)

    def refused(self, number: int, server: Name, reason: str, now_s: float) -> None:
        """Take a replica's word that it has no answer: perhaps it follows another by now."""
        replica = self._replicas.get(server)
        if replica is not None and replica.follows:
            self._ask(server, replica, now_s)
            self._calls.refuse(number, server, reason, self._replicas.following().keys())

    def declined(self, number: int, server: Name, answer: A, now_s: float) -> None:
        """Take an answer; a service's are all the same."""
        self.answered(number, server, answer, now_s)

    def timeout(self, now_s: float) -> None:
        """Do what is due."""
        self._calls.expire(now_s)
        self._look(now_s)

    def next_timeout(self) -> float | None:
        """Return the monotonic second at which a call's time runs out, or None; all else can wait for a tick."""
        return self._calls.next_timeout()

    def fail_all(self, reason: str) -> None:
        """End every call. The log stays: whoever comes gets it."""
        self._calls.fail_all(Failure.NO_SERVER, reason)

    def take(self) -> list[Effect]:
        """Return, once, what is to be sent, in order."""
        effects, self._effects = self._effects, []
        return effects

    def _look(self, now_s: float) -> None:
        """Ask whoever owes a word; begin the log when all have said where they are."""
        for server, replica in self._replicas.items():
            is_behind = replica.follows and replica.position is not None and replica.position.at < self._entries.last
            if now_s >= replica.quiet_until_s and (is_behind or not replica.follows):
                self._ask(server, replica, now_s)
        if self._state_asked is not None and now_s >= self._state_until_s:
            self._state_asked = None
        if not self._is_sent and not any(each.follows or each.is_offered for each in self._replicas.values()):
            self._is_keeping = False  # nobody took it up: it may begin from another replica
        if not self._is_keeping and self._replicas and now_s >= self._collect_until_s:
            self._begin_log(now_s)
        self._keep_small(now_s)

    def _ask(self, server: Name, replica: Replica, now_s: float) -> None:
        replica.quiet_until_s = now_s + (STALL_S if replica.follows else AGAIN_S)
        replica.is_offered = False
        self._effects.append(Word(server, Keep(self._log.life)))

    def _let_go(self, server: Name) -> None:
        self._replicas.pop(server, None)
        if self._state_asked == server:
            self._state_asked = None
        if not self._replicas:
            self._kept_by = None

    def _take_position(self, server: Name, replica: Replica, position: Position, now_s: float) -> None:
        replica.position = position
        replica.why_not, replica.is_offered = "", False
        replica.quiet_until_s = now_s + AGAIN_S
        if position.kept_by is not None:
            replica.follows = False
            self._yield_to(position.kept_by, position.log, now_s)
            return
        if not self._replicas.is_kept_otherwise():
            self._kept_by = None
        has_rest = self._entries.forgotten <= position.held <= self._entries.last  # or can get it
        replica.follows = self._is_keeping and position.log == self._log and has_rest
        if replica.follows:
            replica.quiet_until_s = now_s + STALL_S
            replica.sent = position.held
            self._feed(server, replica)
        elif self._is_keeping and position.log > self._log:
            self._calls.fail_all(Failure.REFUSED, "another kept this service in order meanwhile")
            self._collect_until_s = now_s + COLLECT_S
            self._begin_anew()
        elif self._is_keeping:
            self._admit(server, replica, position, now_s)

    def _yield_to(self, other: Name, log: Log, now_s: float) -> None:
        """Learn that a replica follows another: that log holds, unless ours is begun and greater."""
        if self._replicas.following() and log < self._log:
            return  # it is the other that yields
        self._kept_by = other
        self._calls.fail_all(Failure.REFUSED, f"kept in order by {other.short}")
        if self._is_keeping or self._entries.last:
            self._collect_until_s = now_s + COLLECT_S
            self._begin_anew()

    def _begin_log(self, now_s: float) -> None:
        """Begin the log from the replica that is furthest, if nobody follows another."""
        known = self._replicas.known()
        if self._replicas.is_kept_otherwise():
            return
        sound = {name: position for name, position in known.items() if not position.is_lost}
        for name in known.keys() - sound.keys():
            self._replicas[name].why_not = _UNKNOWN
        if not sound:
            return
        best = max(sound.values(), key=lambda position: (position.log, position.held, position.at))
        if best.at < best.held:
            return  # its server does the rest first; it is asked again
        root = min(name for name, each in sound.items() if (each.log, each.at) == (best.log, best.at))
        self._log = Log(max(position.log.generation for position in known.values()) + 1, self._log.life)
        if best.log.life != self._log.life:  # else it took up this log when nobody heard it
            self._base = best.log, best.at
        self._is_keeping, self._kept_by = True, None
        for replica in self._replicas.values():
            replica.why_not = ""
        self._follow(root, self._replicas[root], Follow(self._log, 0, best.log, best.at, None), now_s)

    def _follow(self, server: Name, replica: Replica, word: Follow, now_s: float) -> None:
        replica.quiet_until_s, replica.is_offered = now_s + SILENT_S, True
        self._effects.append(Word(server, word))

    def _admit(self, server: Name, replica: Replica, position: Position, now_s: float) -> None:
        """Let a replica follow, from where it can."""
        state, is_level = self._entries.state, self._is_level(position) and not self._entries.forgotten
        if not self._replicas.following() and not self._is_sent:
            return  # first comes the one with which it begins
        if position.tells and (position.is_fresh or not is_level):
            if state is not None:
                word = Follow(self._log, state.at, position.log, position.at, state.state)
                self._follow(server, replica, word, now_s)
                return
            if self._state_asked is not None or self._ask_state(now_s):
                return  # it is let in when the state is here
        if is_level:
            self._follow(server, replica, Follow(self._log, 0, position.log, position.at, None), now_s)
        else:
            replica.why_not = _UNKNOWN if position.is_lost else _UNLIKE

    def _is_level(self, position: Position) -> bool:
        """Return whether a replica stands where the log begins."""
        is_begun = position.log.life == self._log.life and position.at == 0
        return not position.is_lost and (is_begun or (position.log, position.at) == self._base)

    def _is_ready(self, replica: Replica) -> bool:
        """Return whether it may have entries: where states can be told, none goes before one of them is here."""
        return replica.follows and (self._entries.state is not None or not self._replicas.tellers())

    def _feed(self, server: Name, replica: Replica) -> None:
        """Send a replica the entries that it lacks, a few ahead of what it has done."""
        if not self._is_ready(replica) or replica.position is None:
            return
        until = min(self._entries.last, replica.position.at + WINDOW)
        if replica.sent < until and replica.sent + 1 not in self._entries:
            replica.follows, replica.position, replica.quiet_until_s = False, None, 0.0  # it must take on a state
            return
        for index in range(replica.sent + 1, until + 1):
            self._effects.append(Ask(call_of(self._log, index), self._entries[index], (server,)))
            self._is_sent = True
        replica.sent = max(replica.sent, until)

    def _done(self, number: int, server: Name, now_s: float) -> Replica | None:
        replica, (life, index) = self._replicas.get(server), place_of(number)
        if replica is None or not replica.follows or replica.position is None:
            return None
        if life != self._log.life or index > self._entries.last:
            return None
        if index > replica.position.at:
            replica.position = replica.position._replace(at=index, held=max(index, replica.position.held))
            replica.sent = max(replica.sent, index)
            replica.quiet_until_s = now_s + STALL_S
        self._feed(server, replica)
        self._trim()
        return replica

    def _keep_small(self, now_s: float) -> None:
        """Ask for a state when the log has grown, or to begin with."""
        if self._is_keeping and self._state_asked is None and self._entries.wants_state:
            self._ask_state(now_s)

    def _ask_state(self, now_s: float) -> bool:
        """Ask the replica that is furthest for its state; return whether there is one to ask."""
        tellers = self._replicas.tellers()
        server = max(tellers, key=lambda name: tellers[name], default=None)
        if server is None or (self._entries.state is not None and tellers[server] <= self._entries.state.at):
            return False
        self._state_asked = server
        self._state_until_s = now_s + SILENT_S
        self._effects.append(Word(server, Tell(self._log)))
        return True

    def _take_state(self, server: Name, replica: Replica, word: State, now_s: float) -> None:
        if server != self._state_asked or word.log != self._log or word.at > self._entries.last:
            return
        self._state_asked = None
        if word.state is None:
            if replica.position is not None:
                replica.position = replica.position._replace(tells=False)
            self._ask(server, replica, now_s)
        else:
            self._entries.learn(word)
        self._trim()
        for name, each in self._replicas.items():
            if each.follows:
                self._feed(name, each)
            elif each.position is not None and each.position.kept_by is None and not each.is_offered:
                self._admit(name, each, each.position, now_s)

    def _trim(self) -> None:
        self._entries.trim(position.at for position in self._replicas.following().values())
