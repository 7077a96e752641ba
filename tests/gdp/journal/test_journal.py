"""Journals: what a run that failed leaves is replayed to the same fault, and says where other code goes another way."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest

from gdp.cli.gdp import main
from gdp.control.boundary import ErrorBoundary
from gdp.crypto.certificates import Role
from gdp.crypto.identity import NodeKeys, node_metadata
from gdp.errors import LocalError
from gdp.frame.codec import Kind
from gdp.journal.incident import Incident
from gdp.journal.journal import Journal
from gdp.journal.replay import Replay, kind_of
from gdp.journal.summary import summary
from gdp.management.control_socket import ControlHandlers, serve_control_in_thread
from gdp.stores.keyring import save_node_keys
from gdp.switch.join_handler import JoinHandler
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.insiders.oracle import signing_oracle
from tests.journeys.flows import advertise

TALKER, READER = "left/talker", "right/reader"
LINE = Topology(
    (Link("left", "middle"), Link("middle", "right")),
    (DomainPlan("one", ("left", "middle", "right")),),
    (Attachment("middle", "rib", "rib"), Attachment("left", "proxy", "talker"), Attachment("right", "proxy", "reader")),
)
MEMORY_BYTES = 64 << 20


@pytest.fixture(autouse=True)
def _ideal_signatures() -> Iterator[None]:
    with signing_oracle():
        yield


@contextmanager
def _defect() -> Iterator[None]:
    """Let no switch process a join; as outside of tests, that ends no node."""
    fails = mock.patch.object(JoinHandler, "handle_join", side_effect=ValueError("a defect"))
    with fails, mock.patch.object(ErrorBoundary, "reraises", new=False):
        yield


def _ran(memory_bytes: int = MEMORY_BYTES) -> tuple[Simulation, int]:
    """Return a network after a flow, and how many messages came."""
    world = Simulation(topology=LINE, journal_bytes=memory_bytes)
    assert world.run_until_attached()
    flow = advertise(world, "/chatter", TALKER)
    flow.read_by(READER)
    world.network.run(2.0)
    flow.publish(b"hello")
    world.network.run(1.0)
    return world, len(world.members[READER].poll_messages())


def _incident(world: Simulation, node: str, folder: Path) -> Incident:
    world.save_journals(folder)
    return Incident.from_bytes((folder / f"{node.replace('/', '-')}.incident").read_bytes())


@pytest.fixture
def incident(tmp_path: Path) -> Incident:
    return _incident(_ran()[0], "left", tmp_path)


def test_the_journal_of_a_failed_run_is_replayed_to_the_same_fault(tmp_path: Path) -> None:
    with _defect():
        world, came = _ran()
        assert came == 0
        incident = _incident(world, "middle", tmp_path)
        replayed = Replay(incident)
        assert replayed.run(lambda core: "a defect" in "".join(core.boundary.poll_tracebacks()))
        received = [more[0] for kind, *more in incident.entries[: replayed.at] if kind == "receive"]
        assert [kind_of(arrival[2]) for arrival in received[-1]] == ["join"]
        assert not replayed.run()
        assert replayed.difference == ""
        assert replayed.drops() == incident.head["drops"]
        assert replayed.drops()["internal"] > 0


def test_other_code_differs_where_it_acts_otherwise(tmp_path: Path) -> None:
    with _defect():
        incident = _incident(_ran()[0], "middle", tmp_path)
    replayed = Replay(incident)
    replayed.run()
    received = [more[0] for kind, *more in incident.entries[: replayed.at] if kind == "receive"]
    assert [kind_of(arrival[2]) for arrival in received[-1]] == ["join"]
    assert replayed.difference


@pytest.mark.parametrize("node", ["left", "middle", "right", "middle/rib"])
def test_a_replay_sends_every_frame_again(node: str, tmp_path: Path) -> None:
    world, came = _ran()
    assert came == 1
    incident = _incident(world, node, tmp_path)
    replayed = Replay(incident)
    replayed.run()
    assert replayed.difference == ""
    assert replayed.sent.total() == sum(kind == "sent" for kind, *_ in incident.entries) > 0


def test_a_replay_names_the_first_frame_that_differs(incident: Incident) -> None:
    at = next(at for at, (kind, *more) in enumerate(incident.entries) if kind == "sent" and more[2][1] == Kind.HELLO)
    port, mac, frame = incident.entries[at][1:]
    entries = [
        *incident.entries[:at],
        ["sent", port, mac, frame[:-1] + bytes([frame[-1] ^ 1])],
        *incident.entries[at + 1 :],
    ]
    replayed = Replay(replace(incident, entries=entries))
    replayed.run()
    assert replayed.difference.startswith(f"entry {at}, ")
    assert replayed.difference.count(f"a hello of {len(frame)} bytes at port {port}") == 2


def test_a_full_ring_keeps_the_last_entries_and_is_not_replayed(tmp_path: Path) -> None:
    world, _ = _ran(10_000)
    incident = _incident(world, "left", tmp_path)
    assert incident.head["first"] > 0
    assert summary(incident)["kind"]
    with pytest.raises(LocalError, match="can be shown, not replayed"):
        Replay(incident)


def test_a_members_journal_is_shown_and_not_replayed(tmp_path: Path) -> None:
    incident = _incident(_ran()[0], READER, tmp_path)
    assert {row["kind"] for row in summary(incident)["kind"]} >= {"data", "keepalive", "acknack"}
    with pytest.raises(LocalError, match="program"):
        Replay(incident)


def test_a_summary_counts_what_came_and_went(incident: Incident) -> None:
    tables = summary(incident)
    sent = sum(kind == "sent" for kind, *_ in incident.entries)
    for title in ("neighbour", "kind", "second"):
        assert sum(int(str(row["out"])) for row in tables[title]) == sent
    assert tables["incident"][0]["replay"] == "exact"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda data: b"", "no incident"),
        (lambda data: b"\x89PNG" + data[4:], "no incident"),
        (lambda data: data[:4] + b"\x07" + data[5:], "of version 7"),
        (lambda data: data[:-40], "damaged"),
        (lambda data: data[:100] + bytes([data[100] ^ 1]) + data[101:], "damaged"),
    ],
)
def test_a_file_that_is_none_or_damaged_is_refused(change: object, says: str, incident: Incident) -> None:
    assert callable(change)
    with pytest.raises(LocalError, match=says):
        Incident.from_bytes(change(incident.to_bytes()))


def test_wrong_values_cause_local_errors_only(incident: Incident) -> None:
    chance = random.Random(1)
    wrong: tuple[object, ...] = (None, -1, 1e300, b"", "x", [], {}, [[]], 1 << 63)
    for _ in range(60):
        head, entries = dict(incident.head), list(incident.entries)
        if chance.random() < 0.5:
            head[chance.choice(list(head))] = chance.choice(wrong)
        at = chance.randrange(len(entries))
        entry = [*entries[at]]
        if len(entry) > 1:
            entry[chance.randrange(1, len(entry))] = chance.choice(wrong)
        entries[at] = entry
        for read in (lambda found: Replay(found).run(), summary, Incident.sealed):
            try:
                read(Incident.from_bytes(Incident(head, entries).to_bytes()))
            except LocalError:
                continue


def test_what_a_node_drew_is_in_its_file_for_that_node_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world, _ = _ran()
    entries = Incident.from_blocks({}, world.journals["left"].blocks()).entries
    drawn = [more[0] for kind, *more in entries if kind == "draw"]
    assert drawn
    kem = world.identities["left"].kem
    keys = NodeKeys.generate(Role.SWITCH, "left")
    save_node_keys(tmp_path / "own", replace(keys, kem=kem), node_metadata(Role.SWITCH, "left"))
    save_node_keys(tmp_path / "other", keys, node_metadata(Role.SWITCH, "left"))
    file = tmp_path / "left.incident"
    handlers = ControlHandlers(status=dict, incident=lambda asked: world.journals["left"].page(asked, {0: "eth0"}))
    with serve_control_in_thread(tmp_path / "control.sock", handlers):
        assert _code("save", str(tmp_path / "control.sock"), "-o", str(file)) == 0
    assert file.stat().st_mode & 0o777 == 0o600
    saved = Incident.from_bytes(file.read_bytes())
    assert not [more for kind, *more in saved.entries if kind == "draw" and more[0] in drawn]
    assert saved.opened(kem).entries == entries
    assert _code("show", str(file)) == 0
    assert "eth0" in capsys.readouterr().out
    assert _code("replay", str(file)) == 2
    assert "--keys" in capsys.readouterr().err
    assert _code("replay", str(file), "--keys", str(tmp_path / "other")) == 2
    assert "another node" in capsys.readouterr().err
    assert _code("replay", str(file), "--keys", str(tmp_path / "own")) == 0
    assert "difference" in capsys.readouterr().out


def _code(*arguments: str) -> object:
    with pytest.raises(SystemExit) as ended:
        main(["incident", *arguments])
    return ended.value.code


def test_a_node_without_a_journal_says_how_to_keep_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serve_control_in_thread(tmp_path / "control.sock", ControlHandlers(status=dict)):
        assert _code("save", str(tmp_path / "control.sock")) == 2
    assert "set journal in its configuration" in capsys.readouterr().err


def test_pages_that_the_ring_overtakes_are_refused() -> None:
    journal: Journal = _ran(10_000)[0].journals["left"]
    with pytest.raises(LocalError, match="overwritten"):
        journal.page({"from": 0, "until": 1}, {})
