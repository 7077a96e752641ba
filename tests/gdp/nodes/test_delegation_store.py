"""Delegation store of a node: lookup, expiry and foreign delegations."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.errors import LocalError
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore, EpochTimer
from gdp.sansio import Timestamps
from gdp.stores.issue import delegate, make_domain, make_node, make_owner
from gdp.stores.keyring import DELEGATIONS, load_owner, save_delegation
from gdp.trust.grants import EPOCH_S
from gdp.trust.right import Right

CHATTER = Metadata({"kind": "topic", "name": "/chatter", "type": "std_msgs/msg/String"})
OTHER = Metadata({"kind": "topic", "name": "/other", "type": "std_msgs/msg/String"})


@pytest.fixture
def robot(tmp_path: Path) -> Identity:
    make_domain(tmp_path / "school", "school")
    make_owner(tmp_path / "owner")
    identity = make_node(tmp_path / "robot", Role.PROXY, "robot", tmp_path / "school")
    give(tmp_path, CHATTER, [Right.PUBLISH])
    return identity


def give(folder: Path, metadata: Metadata, rights: list[Right], *, ago_s: float = 0.0) -> Path:
    """Let the owner delegate for a day."""
    card = folder / "robot" / "node.card"
    delegation = delegate(folder / "owner", card, metadata, rights, days=1.0, unix_s=time.time() - ago_s)
    return save_delegation(folder / "robot" / DELEGATIONS, delegation)


def name(folder: Path, metadata: Metadata) -> Name:
    return metadata.name(load_owner(folder / "owner").key.public.compressed)


def held(folder: Path, identity: Identity) -> DelegationStore:
    return DelegationStore(folder / "robot" / DELEGATIONS, identity)


def test_what_is_held_is_found_by_its_name_and_right(tmp_path: Path, robot: Identity) -> None:
    found, chatter = held(tmp_path, robot), name(tmp_path, CHATTER)
    assert [topic.name for topic in found] == [chatter]
    topic = found.find(chatter, Right.PUBLISH)
    assert topic is not None
    assert [len(secret) for secret in topic.secrets.values()] == [32]
    assert found.get(chatter) is topic
    assert found.find(chatter, Right.READ) is None
    assert found.get(name(tmp_path, OTHER)) is None


def test_what_is_held_says_what_it_is_about(tmp_path: Path, robot: Identity) -> None:
    give(tmp_path, OTHER, [Right.READ])
    found = held(tmp_path, robot)
    assert list(found.described(Right.READ)) == [(OTHER, name(tmp_path, OTHER))]
    assert list(found.described(Right.PUBLISH)) == [(CHATTER, name(tmp_path, CHATTER))]
    assert list(found.described(Right.CALL)) == []


def test_an_expired_one_is_reported_and_left_out(
    tmp_path: Path, robot: Identity, caplog: pytest.LogCaptureFixture
) -> None:
    give(tmp_path, OTHER, [Right.READ], ago_s=5 * 86_400)
    assert [topic.name for topic in held(tmp_path, robot)] == [name(tmp_path, CHATTER)]
    (reported,) = caplog.messages
    assert reported.startswith("delegation left out of=/other reason=")


def test_one_of_another_node_is_reported_and_left_out(
    tmp_path: Path, robot: Identity, caplog: pytest.LogCaptureFixture
) -> None:
    other = make_node(tmp_path / "other", Role.PROXY, "other", tmp_path / "school")
    assert list(held(tmp_path, other)) == []
    assert len(caplog.messages) == 1
    assert list(held(tmp_path, robot))


def test_a_file_that_is_no_delegation_is_refused_with_its_name(tmp_path: Path, robot: Identity) -> None:
    path = next((tmp_path / "robot" / DELEGATIONS).iterdir())
    path.write_bytes(b"nonsense")
    with pytest.raises(LocalError, match=path.name):
        held(tmp_path, robot)


def test_a_file_that_others_can_read_is_refused(tmp_path: Path, robot: Identity) -> None:
    path = next((tmp_path / "robot" / DELEGATIONS).iterdir())
    path.chmod(0o644)
    with pytest.raises(LocalError, match=path.name):
        held(tmp_path, robot)


def test_a_writer_seals_under_tomorrows_epoch_from_tomorrow_on_and_a_reader_opens_it_an_hour_before(
    tmp_path: Path, robot: Identity, monkeypatch: pytest.MonkeyPatch
) -> None:
    day = int(time.time() // EPOCH_S) + 1
    card = tmp_path / "robot" / "node.card"
    given = delegate(tmp_path / "owner", card, CHATTER, [Right.PUBLISH], [0, day], days=3)
    save_delegation(tmp_path / "robot" / DELEGATIONS, given, force=True)

    def at(unix_s: float) -> tuple[int, int]:
        monkeypatch.setattr(time, "time", lambda: unix_s)
        (topic,) = held(tmp_path, robot)
        return max(topic.own_secrets), max(topic.secrets)

    begin_s = day * EPOCH_S
    assert [at(begin_s - 3_601), at(begin_s - 3_599), at(begin_s)] == [(0, 0), (0, day), (day, day)]


def test_delegations_are_read_again_an_hour_before_midnight_and_at_midnight() -> None:
    reloads = list[float]()
    at_s = 20_000 * EPOCH_S - 7_200.0
    timer = EpochTimer(lambda: reloads.append(at_s))
    for _ in range(4 * 60):
        timer.handle_timer(Timestamps(0.0, at_s))
        at_s += 60.0
    assert reloads == [20_000 * EPOCH_S - 3_600.0, 20_000 * EPOCH_S]
