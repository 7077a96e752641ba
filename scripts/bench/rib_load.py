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

from machine import resident_bytes

from gdp.control.query import Query
from gdp.control.relay import Relay
from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.keys import SigningKey
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.errors import LocalError
from gdp.metadata import Metadata
from gdp.rib.core import RibCore, RibSettings
from gdp.rib.store import MemoryStore
from gdp.sansio import Timestamps
from gdp.trust.adcert import AdCert
from gdp.trust.advertisement import sign_advertisement
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert

QUERIES = 1_000


@dataclass(frozen=True, slots=True)
class Load:
    """Processor time and growth of one RIB."""

    advertisements_per_s: float
    queries_per_s: float
    bytes_a_name: float


def advertisements(count: int, validity: Validity, proxy: Identity, switch: Identity, owner: SigningKey) -> list[bytes]:
    """Return relayed advertisements of so many names."""
    rtcert = RtCert.make(proxy, switch.name, validity)
    made = []
    for number in range(count):
        about = Subject.of(topic(number), owner.public.compressed)
        adcert = AdCert.make(owner, about.name, about, proxy.subject, {Right.PUBLISH}, validity, may_delegate=False)
        advertisement = sign_advertisement(
            proxy,
            Right.PUBLISH,
            about,
            rtcert=rtcert,
            sequence=number + 1,
            incarnation=1,
            lease_s=60.0,
            is_global=False,
            chain=(adcert,),
        )
        made.append(Relay(advertisement, (), switch.membership).to_wire(switch.name, switch.key))
    return made


def topic(number: int) -> Metadata:
    """Return the subject of the topic with this number."""
    return Metadata({"kind": "topic", "name": f"/topic/{number}"})


def measure(names: int) -> Load:
    """Let a new RIB accept ``names`` advertisements, then answer ``QUERIES`` queries.

    Raises:
        LocalError: it refused some.
    """
    unix_s = time.time()
    validity = Validity.lasting(unix_s, 86_400)
    authority = CertificateAuthority.create("bench", SigningKey.generate(), validity)

    def node(role: Role, label: str) -> Identity:
        return NodeKeys.generate(role, label).join(authority, validity)

    switch, proxy, me, owner = node(Role.SWITCH, "s"), node(Role.PROXY, "p"), node(Role.RIB, "r"), SigningKey.generate()
    wires = advertisements(names, validity, proxy, switch, owner)
    now = Timestamps(1_000.0, unix_s)
    rib = RibCore(me, Policy(authority.root), MemoryStore(), RibSettings())
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
    name = topic(7).name(owner.public.compressed)
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
