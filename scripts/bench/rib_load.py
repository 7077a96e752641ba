"""Load test of one RIB: whole advertisements a second (relay, advertisement, delegation, route, ack), and queries.

    .venv/bin/python scripts/bench/rib_load.py [NAMES]      one line of JSON; scale.py runs it, a process a round

One process, no network. Each advertisement is a new name under an AdCert of its own, signed by its proxy and relayed by
its switch. The RIB verifies three signatures, and makes one for the AdvertiseAck.
"""

from __future__ import annotations

import gc
import json
import sys
import time
from dataclasses import asdict, dataclass

from domain import BenchDomain
from machine import resident_bytes

from gdp.control.query import Query
from gdp.control.relayed_statement import RelayedStatement
from gdp.crypto.certificates import Role
from gdp.errors import LocalError
from gdp.rib.core import RibCore, RibSettings
from gdp.rib.store import MemoryStore
from gdp.sansio import Timestamps

QUERIES = 1_000


@dataclass(frozen=True, slots=True)
class Load:
    """Processor time and growth of one RIB."""

    advertisements_per_s: float
    queries_per_s: float
    bytes_a_name: float


def measure(names: int) -> Load:
    """Let a new RIB accept ``names`` advertisements, then answer ``QUERIES`` queries.

    Raises:
        LocalError: it refused some.
    """
    unix_s = time.time()
    domain = BenchDomain(unix_s)
    switch = domain.switch
    wires = [
        RelayedStatement(domain.advertisement(number, sequence=number + 1), (), switch.membership).to_wire(
            switch.name, switch.key
        )
        for number in range(names)
    ]
    now = Timestamps(1_000.0, unix_s)
    rib = RibCore(domain.node(Role.RIB, "r"), domain.policy(), MemoryStore(), RibSettings())
    gc.collect()
    before, begun_s = resident_bytes(), time.process_time()
    for wire in wires:
        rib.receive(wire, switch.name, now)
    taken_s = time.process_time() - begun_s
    if rib.accepted != names:
        raise LocalError(f"the RIB took {rib.accepted} of {names} advertisements: {rib.refusals}")
    rib.statements_to_send()
    gc.collect()
    grown = resident_bytes() - before
    name = domain.subject(7).name
    query = Query(name, 0.0).to_wire(switch.name, switch.key, switch.membership)
    begun_s = time.process_time()
    for _ in range(QUERIES):
        rib.receive(query, switch.name, now)
    asked_s = time.process_time() - begun_s
    if rib.answers != QUERIES:
        raise LocalError(f"the RIB answered {rib.answers} of {QUERIES} questions")
    return Load(names / taken_s, QUERIES / asked_s, grown / names)


if __name__ == "__main__":
    print(json.dumps(asdict(measure(int(sys.argv[1]) if len(sys.argv) > 1 else 3_000))))
