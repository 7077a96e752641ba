"""Issue of memberships: the authority signs only what the issuer states, and records all of it."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import typer

from gdp.cli import cert
from gdp.crypto.certificates import Role
from gdp.errors import LocalError
from gdp.stores.issue import make_domain, make_node
from gdp.stores.ledger import LEDGER, read_ledger
from tests.gdp.cli.test_gdp import Run, gdp

__all__ = ["gdp"]

ISSUE = "cert issue --domain school --request far/node.csr --out far.crt"


@pytest.fixture
def far(gdp: Run) -> None:
    """Domain, and the keys of a node that asks to be a RIB under the label of a server."""
    assert gdp("domain init school --label school").code == 0
    assert gdp("keygen node far --role rib --label server").code == 0


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("--role proxy --label server", "asks for the role rib, not proxy"),
        ("--role rib --label robot", "asks for the label 'server', not 'robot'"),
        ("", "--role rib --label server"),
        ("--role rib", "--role rib --label server"),
        ("--label server", "--role rib --label server"),
    ],
)
@pytest.mark.parametrize("how", [ISSUE, "cert issue --domain school --node far"])
def test_a73_a_request_for_more_than_was_stated_is_not_signed(
    gdp: Run, far: None, how: str, line: str, says: str
) -> None:
    done = gdp(f"{how} {line}")
    assert (done.code, done.out) == (2, "")
    assert says in done.err
    assert not Path("far.crt").exists()
    assert not Path("far/node.crt").exists()
    assert read_ledger(Path("school")) == []


def test_a73_what_is_signed_is_said_before(gdp: Run, far: None) -> None:
    done = gdp(f"{ISSUE} --role rib --label server --days 3")
    assert done.code == 0
    name = json.loads(gdp("cert show far.crt --root school/root.crt --json").out)["name"]
    assert f"about to sign: rib 'server', name {name}, for 3 days" in done.err


@pytest.mark.parametrize("says_yes", [True, False])
def test_a73_at_a_terminal_a_person_confirms(
    gdp: Run, far: None, monkeypatch: pytest.MonkeyPatch, says_yes: bool
) -> None:
    class Terminal:
        def isatty(self) -> bool:
            return True

    class System:
        stdin = stderr = Terminal()

    monkeypatch.setattr(cert, "sys", System)
    monkeypatch.setattr(typer, "confirm", lambda *_, **__: says_yes)
    assert gdp(ISSUE).code == (0 if says_yes else 2)
    assert Path("far.crt").exists() == says_yes


def test_a73_what_was_issued_is_written_down(gdp: Run, far: None) -> None:
    gdp(f"{ISSUE} --role rib --label server")
    gdp("lab one --domain school --owner lab")
    (first, *others) = read_ledger(Path("school"))
    shown = json.loads(gdp("cert show far.crt --root school/root.crt --json").out)
    assert (first.role, first.label, first.fingerprint) == ("rib", "server", shown["fingerprint"])
    assert {(each.role, each.label) for each in others} == {("switch", "one"), ("proxy", "one")}
    done = gdp("cert issued --domain school --json")
    assert json.loads(done.out.splitlines()[0])["fingerprint"] == shown["fingerprint"]
    assert Path("school", LEDGER).stat().st_mode & 0o777 == 0o600


def _changed(lines: list[bytes]) -> list[bytes]:
    return [lines[0].replace(b'"proxy"', b'"rib"'), *lines[1:]]


@pytest.mark.parametrize(
    ("forge", "at"),
    [
        (_changed, 2),
        (lambda lines: lines[1:], 1),
        (lambda lines: [lines[0], lines[2]], 2),
        (lambda lines: [lines[0], lines[0], *lines[1:]], 2),
        (lambda lines: [lines[0], b"[]\n", *lines[1:]], 2),
        (lambda lines: [lines[0], lines[1].replace(b"{", b"{ "), lines[2]], 2),
    ],
    ids=["changed", "first gone", "removed", "twice", "other", "rewritten"],
)
def test_a73_a_changed_ledger_is_noticed(tmp_path: Path, forge: Callable[[list[bytes]], list[bytes]], at: int) -> None:
    make_domain(tmp_path / "lab", "lab")
    for index in range(3):
        make_node(tmp_path / str(index), Role.PROXY, "p", tmp_path / "lab")
    path = tmp_path / "lab" / LEDGER
    path.write_bytes(b"".join(forge(path.read_bytes().splitlines(keepends=True))))
    with pytest.raises(LocalError, match=rf"{LEDGER}:{at}: "):
        read_ledger(tmp_path / "lab")


def test_a73_a_line_that_a_crash_tore_is_dropped(tmp_path: Path) -> None:
    make_domain(tmp_path / "lab", "lab")
    make_node(tmp_path / "a", Role.PROXY, "a", tmp_path / "lab")
    path = tmp_path / "lab" / LEDGER
    with path.open("ab") as file:
        file.write(b'{"at_unix_s": 1')
    make_node(tmp_path / "b", Role.PROXY, "b", tmp_path / "lab")
    first, second = read_ledger(tmp_path / "lab")
    assert (first.label, second.label) == ("a", "b")
    assert second.previous == hashlib.sha256(first.to_line()).hexdigest()


def test_a73_issuers_at_the_same_time_write_one_chain(tmp_path: Path) -> None:
    make_domain(tmp_path / "lab", "lab")
    threads = [
        threading.Thread(target=make_node, args=(tmp_path / str(index), Role.PROXY, f"p{index}", tmp_path / "lab"))
        for index in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {each.label for each in read_ledger(tmp_path / "lab")} == {f"p{index}" for index in range(8)}


def test_a73_nothing_is_issued_that_cannot_be_recorded(tmp_path: Path) -> None:
    make_domain(tmp_path / "lab", "lab")
    os.symlink(tmp_path / "elsewhere", tmp_path / "lab" / LEDGER)
    with pytest.raises(LocalError, match=LEDGER):
        make_node(tmp_path / "a", Role.PROXY, "a", tmp_path / "lab")
    assert not (tmp_path / "a" / "node.crt").exists()
    assert not (tmp_path / "elsewhere").exists()
