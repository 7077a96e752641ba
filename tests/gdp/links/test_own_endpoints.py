"""Candidates that a switch publishes, and what its peers make of them."""

from __future__ import annotations

from gdp.control.endpoints import Candidate, CandidateType, Endpoint, EndpointRecord
from gdp.links.own_endpoints import listed_candidates
from gdp.names import Name
from gdp.switch.direct_tunnels import slots_between

PORT = 51_820


def candidate(type_: CandidateType, address: str) -> Candidate:
    return Candidate(0, type_, Endpoint(address, PORT))


def record(number: int, *addresses: str) -> EndpointRecord:
    """Return the record of a switch whose device has the address that its border sees, the first one."""
    hosts = [candidate(CandidateType.HOST, each) for each in addresses[-1:]]
    seen = [candidate(CandidateType.REFLEXIVE, each) for each in addresses[:1]]
    return EndpointRecord(
        name=Name(bytes([number]) * 32),
        keys=(bytes([number]) * 32,),
        candidates=listed_candidates((), seen, hosts),
        sequence=1,
        until_unix_s=0,
        membership=b"",
    )


def test_two_switches_of_one_large_private_network_try_each_others_address() -> None:
    one, other = record(1, "10.1.0.5"), record(2, "10.9.0.7")
    assert [slot.candidate and slot.candidate.endpoint.address for slot in slots_between(one, other)] == ["10.9.0.7"]


def test_a_switch_behind_a_nat_inside_a_private_network_is_met_half_way() -> None:
    one, other = record(1, "10.1.0.5"), record(2, "10.9.0.7", "192.168.1.10")
    assert [slot.candidate and slot.candidate.endpoint.address for slot in slots_between(other, one)] == ["10.1.0.5"]


def test_a_global_address_that_a_peer_sees_is_listed_once() -> None:
    host, seen = (candidate(each, "203.0.113.5") for each in (CandidateType.HOST, CandidateType.REFLEXIVE))
    assert listed_candidates((), [seen, seen], [host]) == (host,)
