"""Endpoint process of the bench of the live view: as in the message bench, but A measures one window an order.

Process of its own, started by ``dashboard.py``.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from peers.exchange import PATIENCE_S, exchange
from peers.gdp_endpoint import PONG, GdpWay, InternalEndpoint, _pong, _serializer, ping_topic
from peers.jsonl import EndSettings, read_order, say

from gdp.runtime.memory_tuning import tune_memory

ENCODING: Final = "cdr"


def main() -> None:
    """Run ``ping`` or ``pong``."""
    settings = EndSettings.from_argument()
    end = InternalEndpoint(Path(settings.own["config"]), float(settings.own["spin_s"]))
    if settings.role == "pong":
        _pong(end, [ENCODING])
        return
    way = GdpWay(end, end.advertise(ping_topic(ENCODING)), _serializer(ENCODING))
    end.subscribe(PONG)
    tune_memory()
    end.wait_for_readers(time.monotonic() + PATIENCE_S)
    say(event="ready")
    while True:
        read_order()
        say(sizes=exchange(way, settings.load, settings.pids))


if __name__ == "__main__":
    main()
