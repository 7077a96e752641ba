"""Replay of a best-effort topic: its report says what was sent, what was dropped here, and what a reader lost."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from gdp.session.keeping import KeptCapsule
from proxy.bridge.sent_stats import SentStats
from proxy.cli.replay import _report
from proxy.node import node as proxy_node
from proxy.node import replayer
from proxy.node.node import ProxyNode
from proxy.node.replayer import Pace, Replay
from proxy.recordings.endpoint import RecordingEndpoint, ReplayEndpoint
from proxy.recordings.reader import BagReader
from proxy.recordings.writer import BagWriter
from tests.proxy.bridge.known import STRING
from tests.proxy.bridge.sites import ROBOT, SERVER, Machine, Sites
from tests.proxy.recordings.test_endpoint import join
from tests.proxy.recordings.test_reader import START_NS, raw, string

CHATTER = f"name: /chatter, type: {STRING}, encoding: cdr"
BEST_EFFORT = f"{CHATTER}, reliable: false"
MESSAGES = 40
LARGE = b"x" * 4_000  # several frames, so that most messages lack one where frames are lost


@dataclass(slots=True)
class Runtime:
    """Main loop in virtual time."""

    sites: Sites
    is_stopped: bool = False

    def step(self, until_s: float | None) -> None:
        self.sites.run(0.01 if until_s is None else max(min(until_s - self.sites.now_s, 0.5), 0.0))

    def run(self, until: Callable[[], bool], deadline_s: float) -> bool:
        return self.sites.run(deadline_s - self.sites.now_s, until)


@pytest.fixture
def sites(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sites:
    sites = Sites(tmp_path)
    clock = SimpleNamespace(monotonic=lambda: sites.now_s)
    monkeypatch.setattr(replayer, "time", clock)
    monkeypatch.setattr(proxy_node, "time", clock)
    return sites


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[BagReader]:
    """A recording with a message every 20 ms."""
    path = tmp_path / "sent.mcap"
    with BagWriter(path, 2) as bag:
        handle = bag.add(string(2))
        for number in range(MESSAGES):
            bag.write(handle, START_NS + number * 20_000_000, raw(2, b"%d" % number + LARGE))
    with BagReader(path) as reader:
        yield reader


def replayed(sites: Sites, reader: BagReader, rule: str, loss: float = 0.0) -> tuple[Replay, Machine]:
    """Replay to the end, over a link that loses frames; return the replay, and the machine that recorded it."""
    endpoint = ReplayEndpoint(reader)
    robot = join(sites, ROBOT, endpoint, expose=[rule])
    server = join(sites, SERVER, RecordingEndpoint(None, [("/chatter", STRING)]), imports=[CHATTER])
    assert sites.run(3, robot.is_read)
    node = ProxyNode.__new__(ProxyNode)  # without files and devices
    node.member, node.runtime = robot.member, cast(Any, Runtime(sites))
    replay = Replay(node, robot.bridge, endpoint, 1.0, lambda: None)
    sites.world.leads[SERVER].loss = loss
    assert replay.run()
    assert replay.finish()
    return replay, server


def test_what_a_best_effort_reader_lost_is_stated_and_nothing_is_called_confirmed(
    sites: Sites, reader: BagReader, capsys: pytest.CaptureFixture[str]
) -> None:
    replay, server = replayed(sites, reader, f"{BEST_EFFORT}, repair: never", 0.08)
    (there,), (here,) = server.bridge.stats, replay.best_effort()
    assert there.received + there.lost == MESSAGES
    assert (replay.confirmed, here.sent, here.reader_lost) == (0, MESSAGES, there.lost)
    _report(reader, replay, [], json=False)
    assert capsys.readouterr().out.splitlines() == [
        "40 messages sent best effort, not confirmed",
        f"  /chatter: 40 sent of 40, a reader lost {there.lost}",
    ]
    assert there.lost > 3


def test_what_could_not_leave_in_time_was_not_sent_and_the_reader_knows_why(sites: Sites, reader: BagReader) -> None:
    replay, server = replayed(sites, reader, f"{BEST_EFFORT}, deadline_ms: 200, max_bits_s: 8000")
    (stats,), (topic,) = replay.best_effort(), server.bridge.stats
    assert (stats.sent, stats.dropped, stats.reader_lost) == (0, {"lifespan": MESSAGES}, MESSAGES)
    assert (topic.received, topic.losses.by_label()) == (0, {"lifespan": MESSAGES})


def test_a_reliable_topic_is_confirmed_and_has_no_best_effort_statistics(sites: Sites, reader: BagReader) -> None:
    replay, server = replayed(sites, reader, CHATTER, 0.1)
    assert (replay.confirmed, replay.best_effort(), server.bridge.stats[0].lost) == (MESSAGES, [], 0)


@pytest.mark.parametrize(
    ("lost", "missing_bytes", "confirmed", "is_held"),
    [(0, 0, (700, 700), True), (1, 0, (700, 700), False), (0, 9, (700, 700), False), (0, 0, (700, 690), False)],
)
def test_a_kept_topic_without_a_reader_is_confirmed_by_its_holders_if_nothing_is_missing(
    sites: Sites, reader: BagReader, lost: int, missing_bytes: int, confirmed: tuple[int, ...], is_held: bool
) -> None:
    endpoint = ReplayEndpoint(reader)
    robot = join(sites, ROBOT, endpoint, expose=[CHATTER])
    assert sites.run(3, lambda: bool(list(robot.member.publications)))
    node = ProxyNode.__new__(ProxyNode)  # without files and devices
    node.member, node.runtime = robot.member, cast(Any, Runtime(sites))
    capsule = KeptCapsule.__new__(KeptCapsule)
    capsule.publishers = {robot.stream.topic: robot.stream}
    capsule._windows, capsule._waiting, capsule.lost = None, deque(), lost
    capsule.ring = cast(Any, SimpleNamespace(end=700, is_written=True))
    uploads = [
        SimpleNamespace(uploader=SimpleNamespace(confirmed=each, missing_bytes=missing_bytes), is_busy=False)
        for each in confirmed
    ]
    capsule._uploads = cast(Any, uploads)
    capsules = SimpleNamespace(topics={robot.stream.topic: capsule})
    replay = Replay(
        node, robot.bridge, endpoint, 0.0, lambda: None, None, cast(Any, SimpleNamespace(capsules=capsules))
    )
    assert replay.run()
    held, unconfirmed = replay.held(), replay.unconfirmed()
    if is_held:
        words = f"/chatter: {MESSAGES} messages without a reader; each of its 2 holders has its capsule, 700 bytes"
        assert ([each.words() for each in held], unconfirmed) == ([words], [])
    else:
        assert (held, [(each.topic, each.why) for each in unconfirmed]) == ([], [("/chatter", "no reader")])


def test_a_message_without_a_reader_is_no_loss_of_a_proxy() -> None:
    stats = SentStats("/a", messages=3, sent=1, dropped={"no-reader": 2}, readers=0, reader_lost=0)
    assert stats.is_whole
    assert stats.words() == "/a: 1 sent of 3 (no-reader 2), no reader"


def test_the_proxy_lists_exposed_best_effort_topics(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[BEST_EFFORT])
    robot.graph.publish("/talker", "/chatter", STRING)
    sites.run(1)
    assert robot.bridge.best_effort == [SentStats.of("/chatter", robot.stream)]


YEARS_NS = 53 * 31_557_600 * 10**9


@pytest.mark.parametrize(
    ("rate", "empty_max_s", "due_s", "said"),
    [
        (
            1.0,
            None,
            [0.0, 53 * 31_557_600.0, 53 * 31_557_600.0 + 1],
            ["no message for 53 years", "--skip-empty SECONDS"],
        ),
        (1.0, 2.0, [0.0, 2.0, 3.0], ["no message for 53 years", "53 years are skipped"]),
        (2.0, 2.0, [0.0, 1.0, 1.5], ["53 years are skipped"]),
        (0.0, None, [0.0, 0.0, 0.0], []),
    ],
)
def test_a_time_without_messages_is_named_with_its_length_or_skipped(
    rate: float, empty_max_s: float | None, due_s: list[float], said: list[str]
) -> None:
    pace = Pace(rate, empty_max_s)
    found = [pace.due_s(stamp_ns) for stamp_ns in (0, YEARS_NS, YEARS_NS + 10**9)]
    assert [due for due, _ in found] == pytest.approx(due_s)
    assert found[0][1] == found[2][1] == ""
    assert all(text in found[1][1] for text in said)
    assert bool(found[1][1]) == bool(said)


def test_stamps_that_go_back_delay_nothing() -> None:
    pace = Pace(1.0, None)
    assert [pace.due_s(stamp_ns)[0] for stamp_ns in (5 * 10**9, 3 * 10**9, 4 * 10**9)] == [0.0, 0.0, 1.0]
