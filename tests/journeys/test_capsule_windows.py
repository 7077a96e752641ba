"""Windows around events: what stands in one reaches the holder, what stands in none does not, whatever happens."""

from __future__ import annotations

import random
from functools import partial
from pathlib import Path

import pytest

from gdp.capsule.audit import Damage
from gdp.capsule.chain import CHECKPOINT_NS
from gdp.capsule.record import Record, RecordType, split
from gdp.intervals import TICK_S
from gdp.stores.capsule_store import stored
from tests.draws import TIMES
from tests.journeys.capsules import Holder, Keeping, opened, read_from
from tests.journeys.flows import ROBOT, advertise, row

SECOND_NS = 1_000_000_000
BEFORE_NS, AFTER_NS = 3 * SECOND_NS, 2 * SECOND_NS
SLACK_NS = CHECKPOINT_NS + int(2 * TICK_S * SECOND_NS)  # a window begins and ends with a checkpoint


class Recorded:
    """A robot that keeps what stands around marks, through restarts, and all that it has written.

    Attributes:
        written: each record of a message, by its time.
        marks: when events were marked.
    """

    def __init__(self, folder: Path, most_bytes: int = 1 << 24) -> None:
        self.world = row()
        self.folder = folder
        self.most_bytes = most_bytes
        self.written: list[tuple[int, bytes]] = []
        self.marks: list[int] = []
        self.holder = Holder(self.world, folder / "holder")
        self.begin()

    def begin(self) -> None:
        """Begin to keep, as after a start."""
        keeping = Keeping(
            advertise(self.world), self.folder / "robot", self.most_bytes, around_ns=(BEFORE_NS, AFTER_NS)
        )
        self.keeping, append = keeping, keeping.kept.ring.append

        def note(data: bytes, *, begins_file: bool) -> None:
            for wire in split(data):
                record = Record.from_wire(wire)
                if record.type is RecordType.MESSAGE:
                    self.written += [(record.time_ns, each.message) for each in opened(wire, keeping)]
            append(data, begins_file=begins_file)

        keeping.kept.ring.append = note  # type: ignore[method-assign]

    def restart(self, *, is_clean: bool) -> None:
        """End the robot's process and start it again."""
        if is_clean:
            self.keeping.keeper.close(self.now_ns / 1e9)
        self.world.restart_member(ROBOT)
        assert self.world.run_until_attached()
        self.begin()

    def mark(self) -> None:
        self.marks.append(self.now_ns)
        self.keeping.kept.mark("/estop", self.now_ns)

    @property
    def now_ns(self) -> int:
        return int(self.world.network.now.unix_s * 1e9)

    def is_within(self, time_ns: int, slack_ns: int) -> bool:
        """Return whether a time stands in a window that is longer by this on both sides."""
        return any(at - BEFORE_NS - slack_ns <= time_ns <= at + AFTER_NS + slack_ns for at in self.marks)


def numbered(base: int, each: int) -> bytes:
    return b"%d " % (base + each) + bytes(500)


def end(robot: Recorded) -> list[bytes]:
    """Run until all windows have ended and are at the holder; return the messages that it has."""
    robot.keeping.run(AFTER_NS / 1e9 + 7, robot.holder)
    assert robot.keeping.run(90, robot.holder, until=lambda: robot.keeping.kept.is_uploaded)
    kept, reader = read_from(robot.holder, robot.keeping)
    assert reader.audit.findings == []
    assert {each.description for each in kept} <= {b"described"}
    assert [each.name for each in reader.opener.marks] == ["/estop"] * len(reader.opener.marks)
    assert reader.lost == []
    return [each.message for each in kept]


@pytest.mark.parametrize("seed", range(8 * TIMES - 4))
def test_exactly_the_union_of_windows_reaches_the_holder(tmp_path: Path, seed: int) -> None:
    rng, robot, number = random.Random(seed), Recorded(tmp_path), 0
    for _ in range(rng.randrange(3, 6)):
        duration_s = rng.uniform(3, 9)
        times_s = sorted(rng.uniform(0, duration_s) for _ in range(rng.randrange(0, 60)))
        robot.keeping.publish_at(times_s, partial(numbered, number))
        number += len(times_s)
        for _ in range(rng.choice([0, 0, 1, 2])):
            robot.world.network.call(rng.uniform(0, duration_s), robot.mark)
        at_s = 0.0
        while (at_s := at_s + rng.uniform(0.2, 5)) < duration_s:
            up = rng.random() < 0.5
            robot.world.network.call(at_s, partial(robot.world.network.set_link, robot.world.leads[ROBOT], up=up))
        robot.keeping.run(duration_s, robot.holder)
        robot.world.network.set_link(robot.world.leads[ROBOT], up=True)
        if rng.random() < 0.5:
            robot.restart(is_clean=rng.random() < 0.5)
        if rng.random() < 0.3:
            robot.holder.store.close()
            robot.holder.open()
    robot.mark()
    held = end(robot)
    must = [message for time_ns, message in robot.written if robot.is_within(time_ns, 0)]
    may = {message for time_ns, message in robot.written if robot.is_within(time_ns, SLACK_NS)}
    assert [each for each in held if each in set(must)] == must
    assert set(held) <= may
    assert len(held) == len(set(held))


def test_without_a_mark_nothing_is_uploaded_and_the_ring_stays_small(tmp_path: Path) -> None:
    robot = Recorded(tmp_path, most_bytes=1 << 20)
    robot.keeping.publish_at([0.05 * each for each in range(600)], lambda each: bytes(2_000) + b"%d" % each)
    robot.keeping.run(31, robot.holder)
    assert list(stored(tmp_path / "holder")) == []
    assert robot.keeping.kept.is_uploaded
    ring_ = robot.keeping.kept.ring
    assert ring_.end > 1_200_000
    assert ring_.end - ring_.begin < 600_000  # a window, and a part of the ring
    assert robot.keeping.kept.poll_faults() == []


def test_a_cut_behind_the_own_switch_leaves_no_path_to_the_holder_until_it_is_healed(tmp_path: Path) -> None:
    robot = Recorded(tmp_path)

    def has_path() -> bool:
        return robot.keeping.keeper.has_path(robot.world.network.now.mono_s)

    assert not has_path()
    assert robot.keeping.run(5, robot.holder, until=has_path)
    uplink = robot.world.cables[frozenset(("nuc1", "nuc2"))]
    for _ in range(2):
        robot.world.network.set_link(uplink, up=False)
        assert robot.keeping.run(3, robot.holder, until=lambda: not has_path())
        assert robot.keeping.flow.member.attachment.switch is not None
        robot.keeping.run(40, robot.holder)
        assert not has_path()
        robot.world.network.set_link(uplink, up=True)
        assert robot.keeping.run(15, robot.holder, until=has_path)


def test_a_window_that_the_ring_could_not_keep_is_named(tmp_path: Path) -> None:
    robot = Recorded(tmp_path, most_bytes=100_000)
    robot.world.network.set_link(robot.world.leads[ROBOT], up=False)
    robot.world.network.call(4, robot.mark)
    robot.keeping.publish_at([0.05 * each for each in range(200)], lambda each: bytes(3_000) + b"%d" % each)
    robot.keeping.run(11, robot.holder)
    robot.world.network.set_link(robot.world.leads[ROBOT], up=True)
    robot.mark()
    robot.keeping.run(8, robot.holder)
    assert robot.keeping.run(60, robot.holder, until=lambda: robot.keeping.kept.is_uploaded)
    assert any("never had" in each for each in robot.keeping.kept.poll_faults())


def test_a_holder_that_withholds_a_window_is_named(tmp_path: Path) -> None:
    robot = Recorded(tmp_path)
    robot.keeping.publish_at([0.1 * each for each in range(300)], lambda each: b"%d" % each)
    for at_s in (4.0, 15.0, 26.0):
        robot.world.network.call(at_s, robot.mark)
    robot.keeping.run(30, robot.holder)
    held = end(robot)
    assert len(held) < 250
    (capsule,) = stored(tmp_path / "holder")
    offsets = capsule.segments.offsets
    assert len(offsets) == 3
    capsule.segments.drop(offsets[1])
    findings = capsule.audit(is_deep=True).findings
    assert [each.damage for each in findings] == [Damage.REMOVED]
    assert "with its window" in findings[0].detail
