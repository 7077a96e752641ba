"""Child process with a run, a disk and a store of six servers; it prints the run's id and waits to be killed.

I/O.
"""

from __future__ import annotations

import sys

from faults.disk import Disk
from faults.store import StoreCluster
from topologies import make_topology

from gdp.host.run_registry import RunRegistry
from lab.namespaces import Namespaces


def main() -> None:
    """Create both, print the id, and wait for the end of standard input."""
    topology, _ = make_topology({"a": ("s1",)}, {}, (), ("s1",), {"P": "s1"})
    run = RunRegistry().start()
    Disk(run).fill()
    StoreCluster(run, Namespaces(topology, run), ["s1"])
    print(run.id, flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()
