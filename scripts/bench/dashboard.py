"""Bench of the live view: the page with 200 nodes and 5,000 names, and what watching costs the message bench.

Two parts, each may run alone:

    page      200 synthetic nodes behind control sockets, a server in a process of its own, headless Chromium with
              software rendering: time to the first picture, frames a second while the graph is dragged and zoomed,
              time from a change to the page, memory of the server
    messages  the row of the message bench, A - s1 - s2 - s3 - B, with metrics at every node. Windows of messages
              alternate: *quiet*, with server and scrapers stopped (SIGSTOP), and *watched*, with a page that
              follows the live view and a scrape of every node each five seconds. All in one run, on the same processes

    sudo .venv/bin/python scripts/bench/dashboard.py --part page --part messages
    sudo .venv/bin/python scripts/bench/dashboard.py --part messages --windows 6     # a short look

The cost is the ratio of medians of neighbouring windows, its spread that of all pairs. Control sockets and counters
exist in both windows: a node always has them. So the bench also measures the processor time of the nodes.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # tests.browser drives the page for tests, too

from peers.chain import LEFT, MIDDLE, RIGHT, Chain
from peers.exchange import Load
from peers.gdp_endpoint import PONG, ping_topic
from peers.jsonl import EndSettings
from peers.process import Started
from report import Rounds
from skeleton import Options, Outcome, command_line, new_run, run_bench
from synthetic_nodes import SyntheticNetwork, serve_network
from testbed import OverlayNodes

from gdp.host.run_registry import RunRegistry
from gdp.management.control_client import control_path
from gdp.runtime.busy_poll import SPIN_US
from gdp.stores.keyring import CARD, load_card
from gdp.trust.right import Right
from tests.browser import console_errors, open_browser

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

PARTS: Final = ("page", "messages")
SWITCHES, PROXIES, NAMES = 60, 136, 5_000  # with four RIBs 200 nodes
PAGE: Final = "200 nodes, 5,000 names"
SIZE: Final = 10_000
CASE: Final = "10 kB, five machines"
_READY_S: Final = 30.0
_FRAMES_S: Final = 6.0

FRAMES: Final = """
const done = arguments[arguments.length - 1];
const canvas = document.getElementById("graph");
const [width, height] = [canvas.clientWidth, canvas.clientHeight];
const box = canvas.getBoundingClientRect();
const send = (type, x, y, more = {}) => canvas.dispatchEvent(new (type === "wheel" ? WheelEvent : PointerEvent)(type, {
  clientX: box.left + x, clientY: box.top + y, pointerId: 1, bubbles: true, cancelable: true, ...more }));
canvas.setPointerCapture = () => {};
send("pointerdown", width / 2, height / 2);
const begun = performance.now();
const times = [];
const works = [];
const step = (at) => {
  times.push(at);
  const turn = (at - begun) / 400;
  const before = performance.now();
  send("pointermove", width / 2 + 150 * Math.sin(turn), height / 2 + 90 * Math.cos(turn * 0.7));
  if (times.length % 3 === 0) send("wheel", width / 2, height / 2, { deltaY: Math.sin(turn / 3) > 0 ? -1 : 1 });
  if (at - begun < SECONDS * 1000) requestAnimationFrame(step);
  else { send("pointerup", width / 2, height / 2); done(times); }
};
requestAnimationFrame(step);
"""

NOTICE: Final = """
window.seen = 0;
const events = document.getElementById("events");
const isThere = () => [...events.children].some((each) => each.innerText.includes("NODE "));
new MutationObserver(() => { if (!window.seen && isThere()) window.seen = Date.now(); })
  .observe(events, { childList: true });
"""


@contextmanager
def live_view(folders: list[Path]) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run ``gdp dashboard`` on these nodes; yield the process and the address."""
    words = [word for each in folders for word in ("--node", str(each))]
    command = [sys.executable, "-m", "gdp.cli.gdp", "dashboard", "--json", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process, json.loads(process.stdout.readline())["url"]
        finally:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            process.wait()


def memory_mib(pid: int) -> float:
    """Return the highest resident memory of a process."""
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1_024


def run_script(driver: Chrome, script: str) -> Any:
    """Return the value of a script."""
    return driver.execute_script(script)


def measure_page(folder: Path) -> dict[str, float]:
    """Open the page in a fresh browser, use it, and return the figures."""
    network = SyntheticNetwork(SWITCHES, PROXIES, NAMES)
    with ExitStack() as stack:
        folders = stack.enter_context(serve_network(network, folder))
        process, url = stack.enter_context(live_view(folders))
        driver = stack.enter_context(open_browser())
        driver.set_script_timeout(60)
        driver.get(url)
        picture_ms = None
        while picture_ms is None:
            picture_ms = run_script(driver, "return performance.getEntriesByName('first-picture')[0]?.startTime")
        time.sleep(3.0)  # as the page of somebody who looks at it
        times = driver.execute_async_script(FRAMES.replace("SECONDS", str(_FRAMES_S)))
        gaps_ms = sorted(after - before for before, after in pairwise(times))
        changes_s = [_time_to_page_s(driver, network, f"robot{number}") for number in range(20, 26)]
        errors = console_errors(driver)
        if errors:
            raise RuntimeError(f"console: {errors[0]}")
        return {
            "first picture, s": picture_ms / 1_000,
            "frames a second, mean": 1_000 * len(gaps_ms) / sum(gaps_ms),
            "frame time p95, ms": gaps_ms[int(0.95 * len(gaps_ms))],
            "change to page, longest, s": max(changes_s),
            "server memory, MiB": memory_mib(process.pid),
        }


def _time_to_page_s(driver: Chrome, network: SyntheticNetwork, node: str) -> float:
    """End a node's socket and return the seconds until an event about it is on the page."""
    run_script(driver, NOTICE.replace("NODE", node))
    ended_s = time.time()
    network.stopped.add(node)
    while not (seen_ms := run_script(driver, "return window.seen")):
        time.sleep(0.05)
    return float(seen_ms) / 1_000 - ended_s


class Watchers:
    """The live view with a page that follows it, and a scraper for each node; all may be stopped and continued."""

    def __init__(self, nodes: OverlayNodes, stack: ExitStack) -> None:
        self.sockets = [control_path(load_card(card).name) for card in sorted(nodes.files.glob(f"nodes/*/{CARD}"))]
        folders = []
        for socket in (each for each in self.sockets if each.exists()):
            folder = nodes.files / "watched" / socket.stem
            folder.mkdir(parents=True)
            (folder / "control.sock").symlink_to(socket)
            folders.append(folder)
        self.nodes = len(folders)
        process, url = stack.enter_context(live_view(folders))
        scrape = (
            "import sys,time,urllib.request as u\n"
            "while True:\n [u.urlopen(each).read() for each in sys.argv[1:]]\n time.sleep(float(5))\n"
        )
        ports = nodes.metrics_urls()
        self._scrapers = [
            stack.enter_context(nodes.lab.start(node, f"scrape-{node}", ["-c", scrape, *urls]))
            for node, urls in ports.items()
        ]
        self._pids = [process.pid, *(each.pid for each in self._scrapers)]
        self._ended = threading.Event()
        self.messages = 0
        reader = threading.Thread(target=self._read, args=(url,), daemon=True)
        reader.start()
        stack.callback(reader.join, 2.0)
        stack.callback(self._ended.set)

    def signal(self, number: int) -> None:
        """Stop or continue all."""
        for pid in self._pids:
            os.kill(pid, number)

    def _read(self, url: str) -> None:
        from websockets.exceptions import ConnectionClosed
        from websockets.sync.client import connect

        with connect(url.replace("http", "ws") + "live", ping_interval=None) as page:
            while not self._ended.is_set():
                with suppress(TimeoutError):
                    try:
                        page.recv(0.5)
                    except ConnectionClosed:
                        return
                    self.messages += 1


def measure_messages(options: Options, runs: RunRegistry) -> tuple[list[float], list[float], dict[str, Any]]:
    """Return the medians of quiet and of watched windows in ms, in their order, and notes."""
    load, spin_s = Load((SIZE,), options.count), SPIN_US / 1e6
    quiet, watched, cpu = list[float](), list[float](), {False: list[float](), True: list[float]()}
    with new_run(runs) as run, ExitStack() as stack:
        chain = Chain(1_500, run)
        nodes = OverlayNodes(chain, MIDDLE, plane="kernel", label="dashboard", metrics=True)
        stack.callback(nodes.close)

        def end(node: str, role: str, pids: Mapping[str, list[int]]) -> Started:
            pings, pongs = [ping_topic("cdr")], [PONG]
            published, read = (pings, pongs) if role == "ping" else (pongs, pings)
            config = nodes.admit_member(node, {Right.PUBLISH: published, Right.READ: read})
            own = {"config": str(config), "spin_s": str(spin_s)}
            argument = EndSettings(role, load, dict(pids), own).to_argument()
            started = chain.start(node, role, ["-m", "dashboard_endpoint", argument], has_orders=role == "ping")
            stack.enter_context(started).read(_READY_S)
            return started

        pong = end(RIGHT, "pong", {})
        pids = {"receiver": [pong.pid], "between": [each.pid for each in nodes.switches]}
        ping = end(LEFT, "ping", pids)
        watchers = Watchers(nodes, stack)
        for number in range(options.windows + 1):
            for is_watched in (False, True) if number % 2 else (True, False):
                watchers.signal(signal.SIGCONT if is_watched else signal.SIGSTOP)
                time.sleep(0.3)
                said: Any = ping.ask(go=True)
                row = said["sizes"][0]
                if number == 0:
                    continue  # caches fill
                (watched if is_watched else quiet).append(1_000 * statistics.median(row["rtt_s"]))
                cpu[is_watched].append(1e6 * row["cpu_s"]["between"])
        notes = {
            "nodes that are watched": watchers.nodes,
            "messages that the page received": watchers.messages,
            "switches' CPU a message, quiet, us": round(statistics.median(cpu[False]), 1),
            "switches' CPU a message, watched, us": round(statistics.median(cpu[True]), 1),
        }
        watchers.signal(signal.SIGCONT)
        return quiet, watched, notes


def interval(quiet: list[float], watched: list[float]) -> str:
    """Return the ratio of the medians of all windows with its 95 % interval, by bootstrap over pairs of windows."""
    dice, pairs = random.Random(1), list(zip(quiet, watched, strict=True))

    def ratio(chosen: list[tuple[float, float]]) -> float:
        """Return the ratio of the medians."""
        return statistics.median(each[1] for each in chosen) / statistics.median(each[0] for each in chosen)

    drawn = sorted(ratio(dice.choices(pairs, k=len(pairs))) for _ in range(2_000))
    return f"{ratio(pairs):.3f} ({drawn[50]:.3f}-{drawn[-51]:.3f})"


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure the parts."""
    over, targets, notes = Rounds(), [], dict[str, Any]()
    parts = options.part or PARTS
    if "page" in parts:
        for _ in range(options.rounds):
            with tempfile.TemporaryDirectory() as folder:
                for column, figure in measure_page(Path(folder)).items():
                    over.add("live view", PAGE, column, figure)
        for column, bound, at_most in (
            ("first picture, s", 2.0, True),
            ("server memory, MiB", 150.0, True),
            ("frames a second, mean", 60.0, False),
            ("change to page, longest, s", 1.0, True),
        ):
            targets.append(over.target(f"{column}, {PAGE}", "live view", PAGE, column, bound, at_most=at_most))
    if "messages" in parts:
        quiet, watched, notes = measure_messages(options, runs)
        for before, after in zip(quiet, watched, strict=True):
            over.add("quiet", CASE, "median, ms", before)
            over.add("watched", CASE, "median, ms", after)
        notes["ratio of medians over all windows, 95 % interval"] = interval(quiet, watched)
        what = f"watched / quiet, {CASE}"
        targets.append(over.ratio(what, "watched", "quiet", CASE, "median, ms", 1.02, at_most=True))
    settings = {"windows of each kind": options.windows, "messages a window": 4 * options.count, **notes}
    return Outcome("dashboard", "Live view", over, targets, settings, is_whole=set(parts) == set(PARTS))


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = command_line(__doc__, rounds=3, has_record=True)
    parser.add_argument("--part", action="append", choices=PARTS, help="only this part; may be repeated")
    parser.set_defaults(is_whole=lambda options: set(options.part or PARTS) == set(PARTS))
    parser.add_argument("--windows", type=int, default=20, help="of each kind (default: %(default)s)")
    parser.add_argument("--count", type=int, default=150, help="a quarter of the messages of a window (default: 150)")
    return parser


if __name__ == "__main__":
    run_bench(arguments(), measure)
