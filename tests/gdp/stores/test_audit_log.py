"""Audit log on disk: a change is found at its line, a flood does not fill the disk."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp.crypto.certificates import Role
from gdp.errors import LocalError
from gdp.metadata import Metadata
from gdp.stores.audit_log import AuditLog, note_once, verify_audit
from gdp.stores.issue import delegate, make_domain, make_node, make_owner
from gdp.trust.audit import Action, AuditTrail
from gdp.trust.right import Right

NOW = 1_800_000_000.0


def note(folder: Path, count: int = 5) -> Path:
    for number in range(count):
        note_once(folder, Action.ACCEPTED, "name", who=f"{number}", unix_s=NOW + number)
    return folder / "audit.jsonl"


def test_what_was_written_verifies_and_is_private(tmp_path: Path) -> None:
    path = note(tmp_path / "audit")
    found = verify_audit(tmp_path / "audit")
    assert (found.lines, found.first, found.events["accepted", "name"]) == (5, 1, 5)
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda lines: [lines[0], lines[1].replace(b'"who": "1"', b'"who": "7"'), *lines[2:]], 3),
        (lambda lines: [*lines[:2], *lines[3:]], 3),
        (lambda lines: [lines[0], lines[0], *lines[1:]], 2),
        (lambda lines: [*lines[:3], b"nonsense\n", *lines[3:]], 4),
        (lambda lines: [lines[1], lines[0], *lines[2:]], 2),
    ],
    ids=["changed", "removed", "inserted", "no line", "exchanged"],
)
def test_a_break_is_named_with_its_line(
    tmp_path: Path, change: Callable[[list[bytes]], list[bytes]], line: int
) -> None:
    path = note(tmp_path)
    path.write_bytes(b"".join(change(path.read_bytes().splitlines(keepends=True))))
    with pytest.raises(LocalError, match=rf"audit.jsonl:{line}: "):
        verify_audit(tmp_path)


def test_the_chain_goes_on_over_rotation_and_the_disk_stays_bounded(tmp_path: Path) -> None:
    log, trail = AuditLog(tmp_path, file_max_bytes=2_000, files_max=4), AuditTrail()
    trail.begin()
    for second in range(3_000):
        trail.record(Action.REFUSED, "name", who=f"{second}", reason="stale")
        log.write(trail, second * 10.0, NOW + second)
    files = sorted(tmp_path.iterdir())
    assert len(files) <= 4
    assert sum(each.stat().st_size for each in files) < 4 * 2_500
    found = verify_audit(tmp_path)
    assert found.first > 1
    assert found.first + found.lines - 1 == 3_000
    middle = files[1]
    lines = middle.read_bytes().splitlines(keepends=True)
    middle.write_bytes(b"".join(lines[:-1]))
    with pytest.raises(LocalError, match=rf"{files[2].name}:1: does not follow"):
        verify_audit(tmp_path)


def test_a_kill_between_rotation_and_the_next_line_keeps_the_chain(tmp_path: Path) -> None:
    path = note(tmp_path)
    path.rename(tmp_path / "audit-000000000001.jsonl")
    note(tmp_path, 1)
    assert verify_audit(tmp_path).lines == 6


def test_a_line_that_was_cut_off_is_dropped_by_the_next_append(tmp_path: Path) -> None:
    path = note(tmp_path)
    with path.open("ab") as file:
        file.write(b'{"seq": 6')
    assert verify_audit(tmp_path).lines == 5
    note(tmp_path, 1)
    assert verify_audit(tmp_path).lines == 6


def test_a_folder_that_others_may_write_to_is_refused(tmp_path: Path) -> None:
    (tmp_path / "shared").mkdir(mode=0o777)
    (tmp_path / "shared").chmod(0o777)
    with pytest.raises(LocalError, match="0777"):
        AuditLog(tmp_path / "shared")


def test_a_domain_and_an_owner_audit_what_they_sign_refuse_and_revoke(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    domain, owner, node = tmp_path / "school", tmp_path / "owner", tmp_path / "node"
    make_domain(domain, "school")
    make_owner(owner)
    make_node(node, Role.PROXY, "robot", domain)
    topic = Metadata({"kind": "topic", "name": "/a"})
    delegate(owner, node / "node.card", topic, [Right.READ])

    def gdp(*words: object) -> int:
        with pytest.raises(SystemExit) as ended:
            main([*map(str, words)])
        return int(ended.value.code or 0)

    out = tmp_path / "new.crt"
    wrong = ("cert", "issue", "--domain", domain, "--request", node / "node.csr", "--role", "rib", "--label", "robot")
    assert gdp(*wrong, "--out", out) == 2
    assert gdp("cert", "revoke", node / "node.crt", "--domain", domain, "--out", tmp_path / "r") == 0
    capsys.readouterr()
    assert gdp("audit", "verify", domain, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["accepted membership proxy"], said["refused membership"], said["revoked membership"]) == (1, 1, 1)
    assert verify_audit(owner).events["accepted", "delegation"] == 1
