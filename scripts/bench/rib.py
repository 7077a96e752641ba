"""How many advertisements one RIB takes in a second, whole: relay, claim, delegation, route, verdict.

One process, no network. Each advertisement is a new name under an AdCert of its own, signed by its proxy and relayed by
its switch: three signatures to check, and one to make for the verdict.

    .venv/bin/python scripts/bench/rib.py [--names 3000] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import time
from pathlib import Path

from gdp.control.query import Query
from gdp.control.relay import Relay
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.issuing import DomainAuthority
from gdp.crypto.keys import SigningKey
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.effects import Instant
from gdp.metadata import Metadata
from gdp.rib.machine import Rib, RibSettings
from gdp.rib.store import MemoryStore
from gdp.trust.adcert import AdCert
from gdp.trust.claim import make_claim
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert

GOAL_PER_S = 2_000
RUNS = 5


def resident_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / (1 << 20)


def advertisements(count: int, validity: Validity, proxy: Identity, switch: Identity, owner: SigningKey) -> list[bytes]:
    """Return relayed claims on so many names."""
    rtcert = RtCert.make(proxy, switch.name, validity)
    made = []
    for number in range(count):
        subject = Metadata({"kind": "topic", "name": f"/topic/{number}"})
        about = Subject.of(subject, owner.public.compressed)
        adcert = AdCert.make(owner, about.name, about, proxy.subject, {Right.PUBLISH}, validity, may_delegate=False)
        claim = make_claim(
            proxy, Right.PUBLISH, about, rtcert=rtcert, sequence=number + 1, incarnation=1, lease_s=60.0,
            is_global=False, chain=(adcert,),
        )  # fmt: skip
        made.append(Relay(claim, (), switch.membership).to_wire(switch.name, switch.key))
    return made


def main() -> None:
    """Run the bench."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--names", type=int, default=3_000)
    parser.add_argument("--json", type=Path, help="also write the result to this file")
    options = parser.parse_args()
    unix_s = time.time()
    validity = Validity.lasting(unix_s, 86_400)
    authority = DomainAuthority.found("bench", SigningKey.generate(), validity)

    def node(role: Role, label: str) -> Identity:
        return NodeKeys.generate(role, label).join(authority, validity)

    switch, proxy, me, owner = node(Role.SWITCH, "s"), node(Role.PROXY, "p"), node(Role.RIB, "r"), SigningKey.generate()
    wires = advertisements(options.names, validity, proxy, switch, owner)
    now = Instant(1_000.0, unix_s)
    rates, answers = [], []
    before = resident_mib()
    for _ in range(RUNS):
        rib = Rib(me, Policy(authority.root), MemoryStore(), RibSettings())
        begun = time.process_time()
        for wire in wires:
            rib.receive(wire, switch.name, now)
        rates.append(len(wires) / (time.process_time() - begun))
        assert rib.accepted == len(wires), rib.refusals
        rib.take()
        name = Metadata({"kind": "topic", "name": "/topic/7"}).name(owner.public.compressed)
        query = Query(name, 0.0).to_wire(switch.name, switch.key, switch.membership)
        begun = time.process_time()
        for _ in range(1_000):
            rib.receive(query, switch.name, now)
        answers.append(1_000 / (time.process_time() - begun))
        assert rib.answers == 1_000
        size = resident_mib() - before
    result = {
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "advertisements_per_s": round(statistics.median(rates)),
        "advertisements_spread": [round(min(rates)), round(max(rates))],
        "goal_per_s": GOAL_PER_S,
        "queries_per_s": round(statistics.median(answers)),
        "resident_growth_mib": round(size, 1),
    }
    for key, value in result.items():
        print(f"{key:24}{value!s:>18}")
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
