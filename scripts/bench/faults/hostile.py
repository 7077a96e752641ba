"""Member that turned hostile and floods: a process of its own, started by ``security.py flood``.

I/O. It is a switch (``names``, ``joins``, ``revocations``) or a proxy that reads and publishes (``reports``,
``parts``). It is a real node and continues to work while it floods. Its frames leave from its own address, and its
session stays up. Its only argument is JSON: ``what``; ``config``, its file; ``frames``, how many different ones;
``rate`` a second; ``seconds``; for a proxy ``reads`` and ``publishes``, topics. It prints a line of JSON when it takes
part, begins to flood at SIGUSR1, and prints another line at the end.
"""

from __future__ import annotations

import json
import os
import secrets
import signal
import sys
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any, Final

from member_endpoint import End
from peers.jsonl import say

from gdp.client.writer_proxy import WriterProxyState
from gdp.config.config import SwitchConfig
from gdp.control.fragments import ControlFragmenter
from gdp.control.settings import NodeSettings
from gdp.crypto.certificates import Role
from gdp.crypto.envelope import Sealer
from gdp.errors import DROP_COUNTERS
from gdp.frame.codec import Header, encode
from gdp.frame.kinds import Flag, Kind
from gdp.limits import HOPS_MAX, NACKS_PER_REPORT
from gdp.message.acknack import AckNack, AckNackFlag, MissingRange
from gdp.nodes.membership import incarnation, load_member, wall_clock_ms
from gdp.ports.mmsg import make_batch
from gdp.ports.raw import RawPlane
from gdp.ports.sockets import attach_drop_all_filter, open_port
from gdp.runtime.runtime import Runtime
from gdp.switch.core import SwitchCore
from gdp.switch.table import Table
from gdp.trust.revocation import Revocation

__all__ = ["HostileProxy", "HostileSwitch"]

_BATCH: Final = 32
_NODE_S: Final = 0.002  # pause between two steps of the node itself
_READY_S: Final = 30.0
_MTU: Final = 1_500
_MESSAGE_BYTES: Final = 100_000  # size of a message of which only one part is sent
_Frames = Iterator[bytes]


class HostileSwitch:
    """A switch of the domain."""

    def __init__(self, orders: dict[str, Any]) -> None:
        config = SwitchConfig.load(Path(orders["config"]))
        self._identity, policy = load_member(config.identity, config.domain, Role.SWITCH)
        settings = NodeSettings(
            incarnation=incarnation(), first_sequence=wall_clock_ms(), random_bytes=secrets.token_bytes
        )
        table = Table()
        self._switch = SwitchCore(self._identity, policy, table, settings)
        self._fragmenter = ControlFragmenter(self._identity.name, secrets.randbits(64))
        self.plane = RawPlane([port.iface for port in config.ports], table)
        self.runtime = Runtime(self._switch, self.plane)

    def is_ready(self) -> bool:
        """Return whether it has a tree through the neighbour that it will flood."""
        return any(tree.upstream is not None for tree in self._switch.multicast.trees.all())

    def neighbour(self) -> bytes:
        """Return the address of the switch that it will flood."""
        port = self._switch.hello_protocol.ports[next(iter(self.plane.ports))]
        return next(each.mac for each in port.neighbours.values())

    def names(self) -> _Frames:
        """Yield frames to names that no node advertises."""
        for number in count():
            header = Header(
                Kind.DATA, Flag.LAST, HOPS_MAX, 1, 100, number, 0, 1, 77, secrets.token_bytes(32), self._identity.name
            )  # fmt: skip
            yield encode(header) + bytes(100)

    def joins(self) -> _Frames:
        """Yield joins of a tree that it is part of, each new and valid."""
        multicast = self._switch.multicast
        tree = next(each for each in multicast.trees.all() if each.upstream is not None)
        while tree.upstream is not None and tree.upstream_name is not None:
            terms = multicast._joins.terms(tree, tree.upstream, tree.upstream_name, _MTU)
            multicast._joins.send_join(tree, tree.upstream, tree.upstream_name, terms, tree.evidence)
            for transmit in self._switch.frames_to_send(time.monotonic()):
                yield from transmit.frames

    def revocations(self) -> _Frames:
        """Yield revocations that its own key signs, of certificates that it never issued."""
        until = int(time.time()) + 3_600
        while True:
            wire = Revocation.make(self._identity.key, self._identity.subject, secrets.token_bytes(32), until)
            yield from self._fragmenter.split(Kind.REVOKE, wire, _MTU)


class HostileProxy:
    """A member that reads a topic, and publishes one that others read."""

    def __init__(self, orders: dict[str, Any]) -> None:
        self._end = End(Path(orders["config"]), 0.0)
        self.plane, self.runtime = self._end.plane, self._end.runtime
        self._topic = self._end.subscribe(orders["reads"])
        self._own = self._end.topics[orders["publishes"]]
        self._publisher = self._end.advertise(orders["publishes"], reliable=True)

    def is_ready(self) -> bool:
        """Return whether it reads a topic and has a reader."""
        writer_proxies = self._end.member.writer_proxies_of(self._topic)
        return any(feed.state is WriterProxyState.LIVE for feed in writer_proxies) and self._publisher.readers > 0

    def neighbour(self) -> bytes:
        """Return the address of its switch."""
        return self._end.member.attachment.hello_protocol.all_up()[0].mac

    def reports(self) -> _Frames:
        """Yield AckNacks of a reader that lacks everything, under the key that it has agreed with the publisher."""
        feed = next(
            each for each in self._end.member.writer_proxies_of(self._topic) if each.state is WriterProxyState.LIVE
        )
        note = feed._sealer.sealer(feed._sealer.epoch)
        for number in count(1):
            missing = tuple(MissingRange(number + each, 0, 1 << 17) for each in range(NACKS_PER_REPORT))
            yield note.seal(AckNack(AckNackFlag.NONE, number, 0, missing, number, 0).to_wire())

    def parts(self) -> _Frames:
        """Yield the first part of one large message after the other."""
        member, (epoch, secret) = self._end.member, next(iter(self._own.secrets.items()))
        sealer = Sealer(
            secret=secret,
            epoch=epoch,
            kind=Kind.DATA,
            source=member.name,
            incarnation=member.attachment._incarnation,
            destination=self._own.name,
            signer=member._identity.key,
            random_bytes=os.urandom,
        )
        first = 1 << 40  # a number above all that it published
        for number in count(first):
            yield sealer.seal(number, Flag.RELIABLE, number.to_bytes(8, "big") + bytes(_MESSAGE_BYTES), _MTU)[0]


def _flood(node: HostileSwitch | HostileProxy, frames: list[bytes], rate: float, seconds: float) -> tuple[int, float]:
    """Send frames repeatedly while the node itself continues to work; return how many left, and the time taken."""
    port = next(iter(node.plane.ports.values()))
    macs = node.neighbour() + port.mac
    sink, drops, batch = open_port(port.ifname), [0] * DROP_COUNTERS, make_batch(2_000)
    attach_drop_all_filter(sink)
    at = sent = 0
    begun_s = due_s = last_s = time.monotonic()
    while (now_s := time.monotonic()) < begun_s + seconds and not node.runtime.is_stopped:
        if now_s >= last_s + _NODE_S:
            node.runtime.step(now_s)
            last_s = now_s
        if now_s < due_s:
            node.runtime.step(due_s)
            continue
        chosen = [frames[(at + each) % len(frames)] for each in range(_BATCH)]
        sent += batch.send(sink, chosen, macs, drops)
        at += _BATCH
        due_s = max(due_s + _BATCH / rate, now_s - 0.01)  # frames that could not be sent in time are skipped
    return sent, time.monotonic() - begun_s


def main() -> None:
    """Take part, then flood until the time is over."""
    orders: dict[str, Any] = json.loads(sys.argv[1])
    node: HostileSwitch | HostileProxy = HostileProxy(orders) if "reads" in orders else HostileSwitch(orders)
    is_reported = list[bool]()
    signal.signal(signal.SIGUSR1, lambda *_: is_reported.append(True))
    with node.runtime.signals():
        if not node.runtime.run(node.is_ready, time.monotonic() + _READY_S):
            sys.exit("it did not come to take part")
        make: Callable[[], _Frames] = getattr(node, orders["what"])
        source, frames = make(), list[bytes]()
        while len(frames) < orders["frames"]:
            frames += [frame for frame, _ in zip(source, range(100), strict=False)]
            node.runtime.step(time.monotonic())
        say(ready=True)
        while not is_reported and not node.runtime.is_stopped:
            node.runtime.step(time.monotonic() + 0.1)
        sent, took_s = _flood(node, frames, orders["rate"], orders["seconds"])
        say(sent=sent, seconds=took_s)


if __name__ == "__main__":
    main()
