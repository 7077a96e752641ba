"""Joining of a machine at its first start."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from fog.bootstrap.bundles import machine_boot
from fog.host.bundle import JOIN_FILE, install
from fog.host.joining import join
from gdp.config.config import SwitchConfig
from gdp.config.relay_config import RelayConfig
from gdp.errors import LocalError
from gdp.trust.enrolment_wire import EnrolmentError, UnreachableError
from gdp.trust.join_token import JoinToken
from proxy.config.config import ProxyConfig
from tests.fog.bootstrap.desk import CLUSTER
from tests.gdp.enrolment.lab import Lab, running_lab


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with running_lab(tmp_path, relay_port=8_443) as made:
        yield made


def installed(home: Path, token: JoinToken) -> Path:
    install(home, machine_boot(CLUSTER, "m7", lambda node: ("run", node.package), token, has_relay=True))
    return home


def test_a_machine_joins_with_files_that_its_programs_take(lab: Lab, tmp_path: Path) -> None:
    home = installed(tmp_path / "home", lab.token(label="c-m7"))
    assert join(home)
    config = ProxyConfig.load(home / "proxy.yaml")
    assert [(rule.name, rule.encoding) for rule in config.expose] == [("/plan", "cbor"), ("/map", "json")]
    assert SwitchConfig.load(home / "member" / "switch.yaml").attach == ("proxy0",)
    assert len(RelayConfig.load(home / "member" / "relay.yaml").borders) == 1


def test_a_machine_that_has_joined_keeps_no_token(lab: Lab, tmp_path: Path) -> None:
    token = lab.token()
    home = installed(tmp_path / "home", token)
    join(home)
    left = b"\n".join(path.read_bytes() for path in home.rglob("*") if path.is_file())
    assert token.to_text().encode() not in left
    assert token.secret not in left


def test_a_machine_joins_once(lab: Lab, tmp_path: Path) -> None:
    home = installed(tmp_path / "home", lab.token())
    file = (home / JOIN_FILE).read_bytes()
    assert join(home)
    assert not join(home)
    (home / JOIN_FILE).write_bytes(file)  # as if it was stopped before it deleted the file
    (home / JOIN_FILE).chmod(0o600)
    assert join(home)
    assert not (home / JOIN_FILE).exists()


def test_a_token_that_was_used_is_refused_and_nothing_is_left_half_made(lab: Lab, tmp_path: Path) -> None:
    token = lab.token()
    lab.join("thief", token)
    home = installed(tmp_path / "home", token)
    with pytest.raises(EnrolmentError, match="used already by 'thief'"):
        join(home)
    assert not (home / "member").exists()


def test_a_machine_whose_token_was_used_ends_so_that_it_is_replaced(lab: Lab, tmp_path: Path) -> None:
    token = lab.token()
    lab.join("thief", token)
    home = installed(tmp_path / "home", token)
    argv = [sys.executable, "-m", "fog.host.cli", "--home", str(home), "--json"]
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0
    assert "the domain refuses it" in ended.stdout
    assert "this token was used already by 'thief'" in ended.stdout


def test_a_border_that_cannot_be_reached_is_tried_again(lab: Lab, tmp_path: Path) -> None:
    home = installed(tmp_path / "home", lab.token())
    document = (home / JOIN_FILE).read_text()
    away = replace(lab.token(), servers=("127.0.0.1:1",))
    (home / JOIN_FILE).write_text(f'{{"token": "{away.to_text()}", "label": "c-m7"}}')
    waited: list[float] = []

    def arrive(pause_s: float) -> None:
        waited.append(pause_s)
        if len(waited) == 2:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        join(home, wait=arrive)
    assert waited == [0.2, 0.4]
    with pytest.raises(UnreachableError):
        join(home, deadline_s=0.0, wait=arrive)
    (home / JOIN_FILE).write_text(document)
    assert join(home)


def test_a_file_without_a_token_is_refused(tmp_path: Path) -> None:
    (tmp_path / JOIN_FILE).write_text("{}")
    (tmp_path / JOIN_FILE).chmod(0o600)
    with pytest.raises(LocalError, match="token and label are expected"):
        join(tmp_path)
