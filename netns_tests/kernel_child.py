"""Kernel plane in a child process, for tests that kill it; it prints its programs and polls until killed.

python -m netns_tests.kernel_child link|filter p0 p1 ...
"""

from __future__ import annotations

import sys

from gdp.ports.kernel.plane import KernelPlane
from gdp.ports.kernel.syscall import program_id
from tests.fixtures_forwarding import filled

if __name__ == "__main__":
    table = filled()
    plane = KernelPlane(sys.argv[2:], table, clsact=sys.argv[1] == "filter")
    print(*(program_id(plane._loaded.program_of(port)) for port in plane.ports), flush=True)
    while True:
        plane.poll(None)
