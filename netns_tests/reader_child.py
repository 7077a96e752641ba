"""Reader in a child process: it counts a device's frames until an urgent frame has come and no more follow.

python -m netns_tests.reader_child q1 BYTES        BYTES of socket memory on each lane
"""

from __future__ import annotations

import json
import sys

from gdp.errors import DropReason
from gdp.frame.codec import decode
from gdp.frame.kinds import Flag
from gdp.ports import sockets
from gdp.ports.raw import RawPlane

if __name__ == "__main__":
    sockets._BUFFER_BYTES = int(sys.argv[2])  # type: ignore[misc]
    plane = RawPlane([sys.argv[1]])
    print("ready", flush=True)
    numbers: list[int] = []
    is_over = False
    while True:
        arrivals = plane.poll(0.0 if is_over else None)
        headers = [decode(each.frame) for each in arrivals]
        numbers += [each.number for each in headers if not each.flags & Flag.URGENT]
        if is_over and not arrivals:
            break
        is_over = is_over or len(headers) > sum(not each.flags & Flag.URGENT for each in headers)
    said = {"numbers": numbers, "dropped": plane.counters.drops[DropReason.PORT_FULL]}
    plane.close()
    print(json.dumps(said), flush=True)
