"""Replay of an incident: its core is built and run again in memory, and every frame that it sends is compared.

Sans-I/O. A replay is exact for the journal of a switch or a RIB from its start on. It takes signatures and random bytes
from the journal, so it needs no private key, and cannot speak for the node.
"""

from __future__ import annotations

import functools
import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import islice, takewhile, zip_longest
from typing import Any

from gdp.client.rib_host import RibHost
from gdp.control.hello import NodeSettings
from gdp.crypto.certificates import Membership, Role, Root
from gdp.crypto.identity import Identity
from gdp.crypto.kem import KemPrivateKey, KemPublicKey
from gdp.crypto.statements import parse
from gdp.errors import LocalError
from gdp.frame.codec import KIND_AT, Kind
from gdp.journal.incident import Incident, well_formed
from gdp.journal.journal import CALLS, JournalKey
from gdp.names import Name
from gdp.rib.core import RibCore
from gdp.rib.state import RibSettings
from gdp.rib.store import MemoryStore
from gdp.sansio import OutgoingFrames, Timestamps
from gdp.switch.core import SwitchCore
from gdp.switch.table import Table
from gdp.trust.domain import Policy

Core = SwitchCore | RibHost


@dataclass
class Replay:
    """One replay.

    Args:
        incident: with its random bytes.

    Attributes:
        core: as far as it has been run.
        at: number of the entry that is next.
        now: time of the last call.
        sent: frames by kind.
        difference: where the core first did something else; empty: nowhere.

    Raises:
        LocalError: this incident cannot be replayed, and why.
    """

    incident: Incident
    at: int = 0
    sent: Counter[str] = field(default_factory=Counter)
    difference: str = ""
    core: Core = field(init=False)
    now: Timestamps = field(init=False)

    def __post_init__(self) -> None:
        head = self.incident.head
        if head.get("first"):
            raise LocalError(f"the ring lost its first {head['first']} entries: it can be shown, not replayed")
        if why := head.get("unrepeatable"):
            raise LocalError(f"it can be shown, not replayed: {why}")
        if "drawn" in head:
            raise LocalError("what the node drew is sealed: replay it where its keys are, with --keys DIR")
        with well_formed("head"):
            self.core = self._built(head)
            self.core.count_arrivals(lambda _: self._take("count"))

    def run(self, until: Callable[[Core], bool] = lambda _: False) -> bool:
        """Run to the end, to the first difference, or until ``until`` is true after a call; return whether it is.

        Raises:
            LocalError: an entry is of the wrong form.
        """
        while self.at < len(self.incident.entries) and not self.difference:
            with well_formed(f"entry {self.at}"):
                self._step(*self._next())
            if until(self.core):
                return True
        if not self.difference and (dropped := self.drops()) != self.incident.head.get("drops", dropped):
            self._differ(f"the node dropped {self.incident.head['drops']}, the replay {dropped}")
        return False

    def drops(self) -> dict[str, int]:
        """Return what the core dropped, by reason."""
        return {reason.label: count for reason, count in sorted(self.core.drops().items()) if count}

    def _differ(self, what: str) -> None:
        """Note a difference, if it is the first: a core goes on where one statement raises."""
        since_s = self.now.mono_s - float(self.incident.head["begun"][0])
        self.difference = self.difference or f"entry {self.at - 1}, {since_s:.6f} s after the start: {what}"

    def _next(self) -> list[Any]:
        self.at += 1
        return self.incident.entries[self.at - 1]

    def _peek(self) -> str:
        return self.incident.entries[self.at][0] if self.at < len(self.incident.entries) else "nothing more"

    def _take(self, kind: str) -> Any:
        """Return the value of the next entry, which must be of this kind."""
        if self._peek() != kind:
            self._differ(f"the replay needs {kind!r}, the journal has {self._peek()!r}")
            raise LocalError(self.difference)
        return self._next()[1]

    def _step(self, kind: str, *arguments: Any) -> None:
        if kind == "send":
            self._compare(self.core.frames_to_send(float(arguments[0])))
        elif kind == "timer":
            self.core.get_timer()
        elif kind == "register":
            ask, for_foreign = arguments
            self.core.diagnostics.register(ask, lambda *_: self._take("answer"), for_foreign=for_foreign)
        elif kind in CALLS:
            self._call(kind, arguments)
        else:
            self._differ(f"the journal has {kind!r}, the replay did nothing")

    def _call(self, path: str, arguments: tuple[Any, ...]) -> None:
        values = [convert(each) for convert, each in zip(CALLS[path], arguments, strict=False)]
        named = dict(arguments[len(values)]) if len(arguments) > len(values) else {}
        if path == "diagnostics.ask":
            named |= {"now": Timestamps(*named["now"]), "name": Name(named["name"]), "on_reply": lambda *_: None}
        moments = [each for each in (*values, *named.values()) if isinstance(each, Timestamps)]
        self.now = moments[0] if moments else self.now
        raised = ""
        try:
            functools.reduce(getattr, path.split("."), self.core)(*values, **named)  # type: ignore[operator]
        except Exception as error:  # as the node raised it; compared below
            raised = type(error).__name__
        expected = self._next()[1] if self._peek() == "raised" else ""
        if raised != expected:
            self._differ(f"{path} raised {raised or 'nothing'}, in the journal {expected or 'nothing'}")

    def _compare(self, transmits: list[OutgoingFrames]) -> None:
        """Compare the frames that the core sends with the entries that follow."""
        sent: list[list[Any]] = [["sent", port, mac, frame] for port, mac, frames in transmits for frame in frames]
        was = list(takewhile(lambda entry: entry[0] == "sent", islice(self.incident.entries, self.at, None)))
        for mine, its in zip_longest(sent, was):
            self.at += 1
            if mine != its:
                self._differ(f"the node sent {_described(its)}, the replay {_described(mine)}")
                return
            self.sent[kind_of(mine[3])] += 1

    def _built(self, head: Mapping[str, Any]) -> Core:
        """Return the core as it was at the start of the journal."""
        begun = self.now = Timestamps(*head["begun"])
        root = Root.from_wire(head["root"])
        member = Membership.from_wire(head["member"], root, begun.unix_s)
        sign = lambda _: bytes(memoryview(self._take("sign")))  # noqa: E731
        identity = Identity(
            member, root, JournalKey(member.key, sign, sign), KemPrivateKey(b"", KemPublicKey.from_wire(head["kem"]))
        )
        roots = {each.domain: each for each in map(Root.from_wire, head["roots"])}
        transit, diagnostics = (map(Name, head[part]) for part in ("transit", "diagnostics"))
        policy = Policy(roots[member.domain], roots.values(), transit, diagnostics=diagnostics)
        for is_root, origin, _, wire in head["revoked"]:
            policy.revoked.restore(parse(wire), origin, begun, of_root=is_root)
        settings = NodeSettings(random_bytes=lambda _: self._take("draw"), **head["settings"])
        if member.role is not Role.RIB:
            switch = SwitchCore(identity, policy, Table(), settings)
            ports = head["ports"]
            switch.diagnostic_answers.port_name = lambda index: ports.get(str(index), "")
            return switch
        named = {**head["rib"], **{part: tuple(map(Name, head["rib"][part])) for part in ("upper", "peers")}}
        return RibHost(identity, policy, RibCore(identity, policy, MemoryStore(), RibSettings(**named)), settings)


def _described(entry: list[Any] | None) -> str:
    """Return a frame that was sent, in words; None: there was none."""
    if entry is None:
        return "no further frame"
    _, port, mac, frame = entry
    digest = hashlib.sha256(frame).hexdigest()[:16]
    return f"a {kind_of(frame)} of {len(frame)} bytes at port {port} to {mac.hex(':')} (SHA-256 {digest}...)"


def kind_of(frame: bytes) -> str:
    """Return the word for a frame's kind."""
    try:
        return Kind(frame[KIND_AT]).name.lower().replace("_", "-")
    except (ValueError, IndexError):
        return "frame of an unknown kind"
