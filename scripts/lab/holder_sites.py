"""Sites in a row, each with a holder of one capsule, and a robot that reads it at the nearest one.

I/O, in a folder; the network is simulated. What each holder was asked is kept with its second.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from gdp.capsule.holder import Ask, HolderRequest
from gdp.capsule.opening import Kept
from gdp.capsule.reading import CapsuleReader, given
from gdp.errors import GdpError
from gdp.names import Name
from gdp.session.keeping import CapsuleKeeper
from gdp.session.protocol.nearest_holder import NearestHolder
from gdp.stores.capsule_store import CapsuleStore, StoreLimits
from gdp.trust.right import Right
from lab.inline import Inline
from lab.sites import ROBOT, Sites

WRITER: Final = "a0/writer"
_LIMITS: Final = StoreLimits(owner_bytes=1 << 30, spare_bytes=0)


@dataclass
class Reading:
    """One reading of the capsule.

    Attributes:
        kept: messages that came.
    """

    holder: NearestHolder
    secrets: dict[int, bytes]
    reader: CapsuleReader | None = None
    kept: list[Kept] = field(default_factory=list)

    @property
    def is_done(self) -> bool:
        """Return whether it has ended."""
        return self.reader is not None and self.reader.is_done

    def step(self, now_s: float) -> None:
        """Process an answer, and ask for what follows."""
        if (answer := self.holder.poll_answer()) is not None:
            if self.reader is None:
                (descriptor,) = given(answer.descriptors)
                self.reader = CapsuleReader(descriptor, {descriptor.topic.name: self.secrets})
            else:
                self.kept += self.reader.handle_response(answer)
        if self.holder.is_idle and not self.is_done:
            request = HolderRequest(ask=Ask.LIST) if self.reader is None else self.reader.next_request()
            self.holder.begin(request, now_s)


@dataclass
class HolderSites(Sites):
    """Sites with holders.

    Args:
        folder: of their stores.
        messages: of the capsule, of ``size`` bytes each.
        lacking: site whose holder has the first half alone.
    """

    folder: Path = Path()
    messages: int = 60
    lacking: int | None = None
    sent: list[bytes] = field(default_factory=list)
    stores: dict[str, CapsuleStore] = field(default_factory=dict)
    asked: list[tuple[float, int, Ask]] = field(default_factory=list)  # when, of which site's holder, and what

    def service(self, site: int) -> str:
        """Return the name of the service of a site's holder."""
        return f"store-{site}"

    def settle(self) -> None:
        """Write a capsule, and have all holders hold it."""
        world, sites = self.world, range(len(self.apart_s) + 1)
        member, now = world.add_member(WRITER, "a0"), world.network.now
        assert world.run_until_attached()
        identity = next(each for each in world.identities.values() if each.name == member.name)
        topic = world.topic("/scan", member, [Right.PUBLISH])
        publisher = member.advertise(topic, b"described", reliable=True)
        keeper = CapsuleKeeper(member, identity, self.folder / "ring", start=1, pool=Inline())
        store = world.topic(self.service(0), member, [Right.CALL])
        kept = keeper.keep(topic, publisher, [store], 1 << 28, now.unix_s)
        for number in range(self.messages):
            self.sent.append(number.to_bytes(4, "big") + bytes(self.size))
            publisher.publish(self.sent[-1], now.mono_s)
            keeper.flush(now.unix_s + number / 10)
        keeper.close(now.unix_s + self.messages / 10)
        data = b"".join(each.read_bytes() for each in sorted((self.folder / "ring").rglob("*.records")))
        self._secrets = dict(topic.secrets)
        for site in sites:
            holder = CapsuleStore(self.folder / self.service(site), _LIMITS, lambda: world.network.now.unix_s)
            capsule = holder.adopt(kept.ring.descriptor)
            holder.add(capsule, 0, data[: len(data) // 2] if site == self.lacking else data)
            self.stores[self.label(site)] = holder
        self.run(1.0)

    def answer(self, label: str, request: bytes) -> bytes | str:
        """Return what a holder answers, or why it refuses."""
        self.asked.append((self.now_s, int(label[1]), HolderRequest.from_cbor(request).ask))
        try:
            return self.stores[label].handle(request, Name(b"r" * 32))
        except GdpError as error:
            return str(error)

    def begin_reading(self) -> Reading:
        """Return a reading that ``read`` continues."""
        services = [self.service(site) for site in range(len(self.apart_s) + 1)]
        return Reading(self.cores[ROBOT].nearest_holder(services), self._secrets)

    def read(self, reading: Reading, duration_s: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Read on; return whether ``until`` came true, or the reading ended."""

        def step() -> bool:
            reading.step(self.now_s)
            self.send(ROBOT)
            return reading.is_done or until()

        return self.run(duration_s, step)

    def reads_since(self, begun_s: float) -> list[tuple[float, int]]:
        """Return when records were asked of which site's holder, from a second on."""
        return [(at_s, site) for at_s, site, ask in self.asked if ask is Ask.READ and at_s >= begun_s]

    def close(self) -> None:
        """Close the stores."""
        for each in self.stores.values():
            each.close()
