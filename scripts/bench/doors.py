#!/usr/bin/env python3
"""What a slow Foxglove client costs another one: messages lost and latency, alone and with it.

The door runs in this process without the overlay. Its clients are processes of their own. The slow client takes one
message in the time in which ten are published.

example: scripts/bench/doors.py --json
"""

from __future__ import annotations

import argparse
import json
import statistics
import struct
import subprocess
import sys
import time
from typing import Final

from proxy.doors.foxglove_protocol import SUBPROTOCOLS
from proxy.doors.foxglove_session import FoxgloveSession
from proxy.doors.rules import rules_of
from proxy.doors.types import known_channel
from proxy.endpoints.door import DoorEndpoint, DoorSettings

BYTES: Final = 200_000
RATE_HZ: Final = 100
CLIENT: Final = """
import json, struct, sys, time
from websockets.sync.client import connect
port, pause_s, last = int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
with connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.websocket.v1"], max_size=None, max_queue=1) as socket:
    socket.recv()
    channel = json.loads(socket.recv())["channels"][0]["id"]
    socket.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel}]}))
    numbers, times_ms = [], []
    while not numbers or numbers[-1] < last:
        data = socket.recv()
        if isinstance(data, str):
            continue
        number, sent_ns = struct.unpack_from("<IQ", data, 13)
        numbers.append(number)
        times_ms.append((time.time_ns() - sent_ns) / 1e6)
        if pause_s:
            time.sleep(pause_s)
    print(json.dumps([len(numbers), times_ms]))
"""


def run(seconds: float, *, is_slow_there: bool) -> dict[str, float]:
    """Publish for some seconds to a fast client, perhaps with a slow one; return what both got."""
    count = int(seconds * RATE_HZ)
    settings = DoorSettings(label="foxglove", listen="127.0.0.1:18765", subprotocols=SUBPROTOCOLS)
    door = DoorEndpoint(settings, lambda hub, at, queue: FoxgloveSession(hub, at, "bench", queue), lambda: rules_of([]))
    clients = list[subprocess.Popen[str]]()
    try:
        handle = door.advertise(known_channel("/data", "std_msgs/msg/ByteMultiArray"))
        for pause_s in (0.0, 10 / RATE_HZ) if is_slow_there else (0.0,):
            argv = [sys.executable, "-c", CLIENT, str(door.address[1]), str(pause_s), str(count - 1)]
            clients.append(subprocess.Popen(argv, stdout=subprocess.PIPE, text=True))
        while len(door.graph()) < len(clients):
            time.sleep(0.01)
        begun_s = time.monotonic()
        for number in range(count):
            time.sleep(max(begun_s + number / RATE_HZ - time.monotonic(), 0.0))
            door.publish(handle, struct.pack("<IQ", number, time.time_ns()) + bytes(BYTES))
        results = [json.loads(client.communicate(timeout=120)[0]) for client in clients]
    finally:
        door.shut_down()
        for client in clients:
            if client.poll() is None:
                client.kill()
                client.wait()
    got, times_ms = results[0]
    cuts = statistics.quantiles(times_ms, n=100)
    found = {"published": count, "fast_lost": count - got, "median_ms": cuts[49], "p99_ms": cuts[98]}
    return found | ({"slow_got": results[1][0], "slow_dropped": door.dropped} if is_slow_there else {})


def main() -> None:
    """Run both and print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each run (default: 10)")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    given = parser.parse_args()
    rows = {label: run(given.seconds, is_slow_there=label == "with slow") for label in ("alone", "with slow")}
    if given.json:
        print(json.dumps(rows))
        return
    for label, row in rows.items():
        print(label, ", ".join(f"{key} {value:.2f}".removesuffix(".00") for key, value in row.items()))


if __name__ == "__main__":
    main()
