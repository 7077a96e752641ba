"""Stranger on a link that floods it with hellos: a process of its own, started by ``security.py flood``.

I/O. One packet socket. Its only argument is JSON with ``iface``, ``frames``, ``rate`` (a second), ``seconds`` and
``source``. The file ``frames`` holds frames from the header on, each after its length (4 bytes). The address ``source``
is empty for many invented ones. It prints one line of JSON at its begin and one at its end: the number of frames sent.
"""

from __future__ import annotations

import json
import os
import random
import struct
import sys
import time
from pathlib import Path
from typing import Final

from peers.jsonl import say

from gdp.errors import DROP_COUNTERS
from gdp.ports.mmsg import make_batch
from gdp.ports.sockets import attach_drop_all_filter, open_port

_BATCH: Final = 16  # frames under one source address
_BROADCAST: Final = b"\xff" * 6
_ADDRESSES: Final = 10_000


def main() -> None:
    """Send until the time is over."""
    settings = json.loads(sys.argv[1])
    data, frames = Path(settings["frames"]).read_bytes(), []
    while data:
        (size,) = struct.unpack_from("!I", data)
        frames.append(data[4 : 4 + size])
        data = data[4 + size :]
    random.shuffle(frames)
    sources = [bytes.fromhex(settings["source"])] if settings["source"] else []
    sources = sources or [b"\x06" + os.urandom(5) for _ in range(_ADDRESSES)]
    sink, drops = open_port(settings["iface"]), [0] * DROP_COUNTERS
    attach_drop_all_filter(sink)
    batch, at, sent = make_batch(2_000), 0, 0
    say(ready=True)
    begun_s = time.monotonic()
    while (now_s := time.monotonic()) < begun_s + settings["seconds"]:
        due = int((now_s - begun_s) * settings["rate"]) - at
        if due < _BATCH:
            time.sleep(_BATCH / settings["rate"])
            continue
        for _ in range(min(due // _BATCH, 8)):
            chosen = [frames[(at + each) % len(frames)] for each in range(_BATCH)]
            sent += batch.send(sink, chosen, _BROADCAST + sources[(at // _BATCH) % len(sources)], drops)
            at += _BATCH
        if due > settings["rate"] / 100:
            begun_s += (due - _BATCH) / settings["rate"]  # frames that could not be sent in time are skipped
    say(sent=sent, seconds=time.monotonic() - begun_s)


if __name__ == "__main__":
    main()
