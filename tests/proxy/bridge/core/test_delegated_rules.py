"""Rules of a member without a rules file: its delegations, by their metadata, say what its clients may do."""

from __future__ import annotations

from gdp.client.participant import Topic
from gdp.crypto.keys import SigningKey
from gdp.crypto.subject import Subject
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.trust.delegation import Delegation
from gdp.trust.right import Right
from proxy.bridge.core.delegated_rules import rules_of

OWNER = SigningKey.generate().public.compressed
LASER = "sensor_msgs/msg/LaserScan"
SWITCH = "std_srvs/srv/SetBool"


def held(name: str, type_name: str, *rights: Right, kind: str = "topic", states_it: bool = True) -> Topic:
    """Return a delegation for a name; ``states_it``: it has the name's metadata."""
    metadata = Metadata({"kind": kind, "name": name, "type": type_name})
    subject = Subject.of(metadata, OWNER)
    delegation = Delegation(
        subject=subject,
        node=Name(bytes(32)),
        rights=frozenset(rights),
        chain=(),
        grants={},
        metadata=metadata if states_it else None,
    )
    return Topic(delegation, {})


def test_clients_may_do_what_the_rights_on_a_name_of_that_kind_say() -> None:
    rules = rules_of(
        [
            held("/scan", LASER, Right.READ),
            held("/cmd", LASER, Right.PUBLISH),
            held("/both", LASER, Right.PUBLISH, Right.READ),
            held("/switch", SWITCH, Right.CALL, kind="service"),
            held("/served", SWITCH, Right.SERVE, kind="service"),
        ]
    )
    assert ([each.name for each in rules.imports], [each.name for each in rules.expose]) == (
        ["/scan", "/both", "/switch"],
        ["/cmd", "/both"],
    )
    assert rules.left_out == []
    assert rules.may_read("/scan", LASER) == rules.may_read("/scan", "") == rules.may_call("/switch") == ""
    assert rules.may_publish("/cmd", LASER) == "" != rules.may_publish("/scan", LASER)
    assert "no delegation to call" in rules.may_call("/served")
    assert rules.may_read("/scan", "std_msgs/msg/String") == f"its type is {LASER}, not std_msgs/msg/String"
    assert (rules.type_of("/cmd"), rules.type_of("/scan")) == (LASER, "")


def test_a_delegation_that_does_not_say_what_its_name_means_is_left_out_with_the_reason() -> None:
    unstated, odd = held("/scan", LASER, Right.READ, states_it=False), held("scan", LASER, Right.READ)
    rules = rules_of([unstated, odd, held("/map", LASER, Right.READ)])
    assert [each.name for each in rules.imports] == ["/map"]
    assert [name for name, _ in rules.left_out] == [unstated.name.short, "scan"]
    assert rules.left_out[0][1] == "the delegation does not state the name's metadata"
