"""Child process with a run, a disk and a store of six servers; it prints the run's id and waits to be killed. I/O."""

from __future__ import annotations

import sys

from faults.store import Disk, StoreCluster

from gdp.host.run_registry import RunRegistry
from lab.namespaces import Namespaces
from lab.topology import make_topology


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
