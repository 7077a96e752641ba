"""Members that a border serves: the others get no tunnel, by their files or by the RIB."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import pytest

from gdp.config.config import LinksConfig
from gdp.control.endpoints import Candidate, CandidateType, Endpoint, EndpointRecord
from gdp.control.hello import NodeSettings
from gdp.crypto.certificates import Role
from gdp.crypto.tunnel_key import TunnelKey
from gdp.links.links import TunnelLinks
from gdp.runtime.runtime import Runtime
from gdp.switch.core import SwitchCore
from gdp.switch.table import Table
from tests.gdp.control.members import POLICY, UNIX_S, Nonces, at, node

BORDER, HOME, LEAF = node("border"), node("home"), node("robot", Role.LEAF)


@contextmanager
def links(folder: Path, *relay_for: str) -> Iterator[tuple[TunnelLinks, SwitchCore]]:
    """Yield the tunnels of a border with a file for each member, and its switch."""
    for identity in (HOME, LEAF):
        candidates = (Candidate(0, CandidateType.REFLEXIVE, Endpoint("192.0.2.1", 51_820)),)
        keys = (TunnelKey.derive(identity.kem).public,)
        record = EndpointRecord.make(identity, keys, candidates, sequence=1, until_unix_s=UNIX_S + 600)
        (folder / f"{identity.member.label}.endpoints").write_bytes(record.wire)
    settings = NodeSettings(incarnation=0, first_sequence=0, random_bytes=Nonces(1))
    switch = SwitchCore(BORDER, POLICY, Table(), settings)
    made = TunnelLinks(
        config=LinksConfig(peers=folder, direct=False, relay_for=relay_for),
        identity=BORDER,
        policy=POLICY,
        switch=switch,
        runtime=cast("Runtime", None),  # it has no devices to watch
        underlays=(),
    )
    made._read_records(at(0.0))
    try:
        yield made, switch
    finally:
        made.close(0.0)


@pytest.mark.parametrize(
    ("relay_for", "served"),
    [((), {"home", "robot"}), (("home",), {"home"}), (("leaf",), {"robot"}), (("other",), set())],
)
def test_a_border_takes_the_records_of_the_members_that_it_serves(
    tmp_path: Path, relay_for: tuple[str, ...], served: set[str]
) -> None:
    labels = {each.name: each.member.label for each in (HOME, LEAF)}
    with links(tmp_path, *relay_for) as (_, switch):
        assert {labels[name] for name in switch.tunnels._configured} == served


def test_a_member_that_is_not_served_gets_no_direct_tunnel_either(tmp_path: Path) -> None:
    keys = (TunnelKey.derive(LEAF.kem).public,)
    with links(tmp_path, "home") as (made, _):
        for identity, is_served in ((HOME, True), (LEAF, False)):
            record = EndpointRecord.make(identity, keys, (), sequence=2, until_unix_s=UNIX_S + 600)
            assert made._is_served(record, at(0.0)) is is_served
