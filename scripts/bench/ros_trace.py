"""Trace of images over both proxies, for ``ros.py --trace``: when each passes the seams of its path.

I/O. A process of its own, in place of a proxy or node: ``ros_trace STEM proxy WORDS`` or ``ros_trace STEM ROLE
SETTINGS``. It writes begin and end of each call of a seam, in ns of CLOCK_MONOTONIC, into ``STEM-PID``.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

Call = tuple[int, int]  # begin and end, in ns
Calls = dict[str, list[Call]]  # of each seam, in order

_PROXY: Final = {
    "take": "proxy.endpoints.ros2.wait_thread:WaitThread._drained",
    "expose": "proxy.bridge.exposed_topic:ExposedTopic._publish",
    "seal": "gdp.crypto.envelope:Sealed._seal",
    "send": "gdp.ports.raw:RawPlane.transmit",
    "receive": "gdp.ports.raw:RawPlane.poll",
    "open": "gdp.message.reassembly:Reassembler.add_batch",
    "verify": "gdp.message.reassembly:Reassembler._is_signed",
    "import": "proxy.bridge.imported_topic:ImportedTopic._deliver",
    "publish": "proxy.endpoints.ros2.endpoint:Ros2Endpoint.publish",
}
_NODE: Final = {"talk": "rclpy.publisher:Publisher.publish", "hear": "ros_topics:_Listener._take"}
_SENDER, _RECEIVER = {"seal", "send"}, {"receive", "open", "verify"}
_ORDER: Final = ("talk", "take", "expose", "send", "import", "publish", "hear")
_IMAGES: Final = 60  # the last ones: the first ones fill caches and heap


def read_calls(stem: Path, pids: Iterable[int]) -> Calls:
    """Return the calls that processes have written."""
    calls: Calls = {}
    for pid in pids:
        said: Calls = json.loads(Path(f"{stem}-{pid}").read_text(encoding="ascii"))
        others = _RECEIVER if "expose" in said else _SENDER  # reports are sealed, sent and received, too
        calls |= {seam: each for seam, each in said.items() if seam not in others}
    return calls


def steps_of(calls: Mapping[str, Sequence[Call]]) -> dict[str, float]:
    """Return the medians of the steps of the last images, in ms, each after whose it is."""
    images = [_steps(image) for image in _images(calls) if _is_whole(image)][-_IMAGES:]
    return {step: statistics.median(image[step] for image in images) / 1e6 for step in images[0]} if images else {}


def _images(calls: Mapping[str, Sequence[Call]]) -> Iterable[Calls]:
    """Yield the calls of each image: it arrives before the next one is published."""
    for (begin, _), (end, _) in pairwise(calls["talk"]):
        yield {seam: [each for each in every if begin <= each[1] < end] for seam, every in calls.items()}


def _is_whole(image: Calls) -> bool:
    """Return whether an image passed all seams in their order; a late one meets the next one."""
    if not all(image.values()):
        return False
    begun = [image[seam][0][0] for seam in _ORDER if seam in image]
    return begun == sorted(begun)


def _steps(image: Calls) -> dict[str, float]:
    (said, _), (heard, _) = image["talk"][0], image["hear"][0]
    if "take" not in image:
        return {"all": heard - said}
    (woken, taken), (bridged, queued), (joined, _) = image["take"][0], image["expose"][0], image["import"][0]
    decoded, published = image["publish"][0]
    left = max(end for begin, end in image["send"] if begin < joined)
    came = max(end for _, end in image["receive"] if end <= joined)

    def total(seam: str) -> int:
        return sum(end - begin for begin, end in image[seam] if bridged <= begin < decoded)

    return {
        "all": heard - said,
        "1 rclpy, DDS: the node publishes, the proxy wakes": woken - said,
        "2 rclpy: taken as bytes": taken - woken,
        "3 ours: handed to the proxy's loop": bridged - taken,
        "4 ours: bridge and queue": queued - bridged,
        "5 ours: sealed and sent": left - queued,
        "6 ours: received, after the last frame left": came - left,
        "7 ours: opened and verified, after the last frame came": joined - came,
        "8 ours: bridge": decoded - joined,
        "9 rclpy, DDS: published": published - decoded,
        "10 DDS, rclpy: the node is called": heard - published,
        "of 5: sealing": total("seal"),
        "of 5: sending, through three switches": total("send"),
        "of 5 to 7: opening": total("open"),
        "of 7: verifying": total("verify"),
    }


def _wrap(seam: str, where: str, calls: list[Call]) -> None:
    module, _, path = where.partition(":")
    owner_name, name = path.split(".")
    owner = getattr(import_module(module), owner_name)
    original: Callable[..., Any] = getattr(owner, name)

    def timed(*words: Any, **named: Any) -> Any:
        """Call the seam, and note when."""
        begin = time.monotonic_ns()
        returned = original(*words, **named)
        if seam != "receive" or returned:
            calls.append((begin, time.monotonic_ns()))
        return returned

    setattr(owner, name, timed)


def main() -> None:
    """Run the proxy or the node with timed seams."""
    stem, role, *words = sys.argv[1:]
    is_proxy = role == "proxy"
    calls: Calls = {seam: [] for seam in (_PROXY if is_proxy else _NODE)}
    with Path(f"{stem}-{os.getpid()}").open("w", encoding="ascii") as file:  # a confined process opens no more

        def write() -> None:
            """Write the calls so far, once."""
            print(json.dumps({seam: each for seam, each in calls.items() if each}), file=file, flush=True)

        for seam, where in (_PROXY if is_proxy else _NODE).items():
            _wrap(seam, where, calls[seam])
        if is_proxy:
            from proxy.cli.proxy import main as run_proxy

            sys.argv[1:] = words
            try:
                run_proxy()
            finally:
                write()
        else:
            from ros_endpoint import End, Settings, run_role
            from ros_topics import listen, talk

            sys.argv[1:] = [role, *words]
            work = {"talk": talk, "listen": listen}[role]

            def and_write(end: End, settings: Settings) -> None:
                """Do the role's work, and write the calls before that is reported."""
                work(end, settings)
                write()

            run_role({role: and_write})


if __name__ == "__main__":
    main()
