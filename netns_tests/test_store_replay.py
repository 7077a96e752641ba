"""``gdp store replay`` as its user runs it: what a holder has goes to the live readers of an overlay."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from itertools import accumulate

import pytest

from gdp.intervals import TICK_S
from lab.process import until
from netns_tests.history_site import TOPICS, Site, ended, history_site, messages
from netns_tests.session_lab import PATIENCE_S

pytestmark = pytest.mark.netns

SECONDS = 4.0


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    """The site after a drive that nothing has read."""
    with history_site(SECONDS) as made:
        _, lines = ended(made.drive_past())
        assert lines[-1]["event"] == "done"
        yield made


def test_a_span_of_time_is_exported_and_no_more(site: Site) -> None:
    code, whole = site.export("whole.mcap")
    assert (code, [each.raw for each in whole]) == (0, [each.raw for each in site.drive])
    begin, end = whole[len(whole) // 3].stamp_ns, whole[2 * len(whole) // 3].stamp_ns
    code, part = site.export("part.mcap", "--from", f"{begin / 1e9:.9f}", "--to", f"{end / 1e9:.9f}")
    slack_ns = int(2 * TICK_S * 1e9)  # a record has the time at which it was appended
    inner = [each.raw for each in whole if begin + slack_ns < each.stamp_ns < end - slack_ns]
    assert code == 0
    assert set(inner) <= {each.raw for each in part}
    assert all(begin - slack_ns <= each.stamp_ns <= end + slack_ns for each in part)
    assert part == sorted(part, key=lambda each: each.stamp_ns)
    code, folder = site.export("folder", "--to", f"{end / 1e9:.9f}")
    assert (code, (site.lab.folder / "folder/folder.db3").exists()) == (0, True)
    assert len(part) < len(folder) < len(whole)
    assert folder == whole[: len(folder)]


@pytest.mark.parametrize(("rate", "least_s", "most_s"), [(2.0, SECONDS / 2, SECONDS), (0.0, 0.0, SECONDS / 2)])
def test_live_readers_get_what_the_robot_published_in_its_order(
    site: Site, rate: float, least_s: float, most_s: float
) -> None:
    reader, path = site.listen(f"rate-{rate:g}")
    code, lines = ended(site.replay("--rate", f"{rate:g}"))
    assert code == 0, lines
    reader.finish(signal.SIGTERM)
    site.lab.running.remove(reader)
    received = messages(path)
    assert site.places(received) == site.all
    lasted_s = (received[-1].stamp_ns - received[0].stamp_ns) / 1e9
    assert 0.9 * least_s < lasted_s < most_s, lasted_s
    order = {each.raw: number for number, each in enumerate(site.drive)}
    places = [order[each.raw] for each in received]
    late = max(highest - place for highest, place in zip(accumulate(places, max), places, strict=True))
    assert late < len(TOPICS) * 8 or not rate  # at once, a topic's messages share bundles


def test_ctrl_c_ends_a_replay(site: Site) -> None:
    replay = site.replay("--rate", "0.1", "--wait-readers", "0")
    while '"progress"' not in replay.read_line(PATIENCE_S).decode():
        pass
    begun_s = time.monotonic()
    replay.send(signal.SIGINT)
    code, _ = ended(replay)
    assert code == 1
    assert time.monotonic() - begun_s < SECONDS / 0.1 / 4


def test_a_history_with_damage_is_replayed_and_the_exit_code_says_so(site: Site) -> None:
    nothing = site.lab.run(
        "gdp", "store", "replay", "/scan", "--node", "player", "--config", "player.yaml", "--holder", "x"
    )
    assert (nothing.returncode, nothing.stderr[:6]) == (2, "error:")
    segment = next(site.store.rglob("*.records"))
    data = bytearray(segment.read_bytes())
    data[len(data) // 2] ^= 1
    segment.write_bytes(data)
    reader, _ = site.listen("damaged")
    code, lines = ended(site.replay("--rate", "0"))
    assert any("altered" in problem for line in lines for problem in line.get("problems", ()))
    assert lines[-1]["event"] == "done"
    assert code == 1
    reader.finish(signal.SIGTERM)
    until(lambda: reader.code is not None, "the reader ends", PATIENCE_S)
