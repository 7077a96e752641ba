"""A domain is created on a public machine; machines behind NATs join with tokens, and one is removed."""

from __future__ import annotations

import contextlib
import json
import select
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from gdp.errors import GdpError
from gdp.management.control_client import ask_node, find_control_socket
from gdp.metadata import Metadata
from gdp.state.control_protocol import Command
from gdp.stores.issue import delegate, install_delegation
from gdp.stores.keyring import CARD, load_card
from gdp.trust.right import Right
from lab.internet.access import Access
from lab.internet.host import Host
from lab.internet.laboratory import Laboratory
from lab.machine import GDP, gdp
from lab.process import until
from netns_tests.test_trace import traced

pytestmark = pytest.mark.netns

PATIENCE_S = 90.0


@contextlib.contextmanager
def running(host: Host, folder: Path, *words: str, answer: str = "") -> Iterator[subprocess.Popen[str]]:
    """Run ``gdp`` on a host while within, with what it gets when it asks; end it as Ctrl-C does."""
    with (folder / f"{host.label}.log").open("w") as log:
        process = subprocess.Popen(
            host.command([*GDP, *words]),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            start_new_session=True,
        )
        assert process.stdin is not None
        process.stdin.write(answer)
        process.stdin.close()
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.stdin = None  # closed: communicate() would flush it
            process.communicate(timeout=PATIENCE_S)


def links(directory: Path) -> list[dict[str, object]]:
    """Return the tunnels of a machine's switch; empty: the switch is not up yet."""
    with contextlib.suppress(GdpError):
        found = ask_node(find_control_socket(directory / "switch"), Command.STATUS, 5.0).result.get("links")
        return found if isinstance(found, list) else []
    return []


def up(directory: Path) -> set[object]:
    """Return the labels of the peers whose tunnels are up."""
    return {each["label"] for each in links(directory) if each["up"] is True}


def devices(directory: Path) -> set[object]:
    """Return the devices of a machine's tunnels."""
    return {each["device"] for each in links(directory)}


def is_found(name: str, node: Path) -> bool:
    """Return whether a node reaches the member that advertises a name, which it does a moment after its tunnel."""
    return not subprocess.run([*GDP, "trace", name, "--node", str(node)], capture_output=True, check=False).returncode


def switch_name(directory: Path) -> str:
    """Return the name of a machine's switch."""
    return load_card(directory / "switch" / CARD).name.to_text()


def created_domain(stack: contextlib.ExitStack, border: Host, address: str, lab: Path) -> str:
    """Create a domain at a host, in the folder that has the logs; return the line with its token."""
    words = ("domain", "create", "lab", "--public", address, "--directory", str(lab), "--no-systemd")
    created = stack.enter_context(running(border, lab.parent, *words))
    assert created.stdout is not None
    assert select.select([created.stdout], [], [], PATIENCE_S)[0]
    return created.stdout.readline()


def test_machines_behind_nats_join_with_tokens_and_a_removed_one_has_no_tunnel(
    laboratory: Laboratory, tmp_path: Path
) -> None:
    border = laboratory.add_host("border", laboratory.add_site("dc", Access.PUBLIC))
    robot = laboratory.add_host("robot", laboratory.add_site("home", Access.SYMMETRIC))
    arm = laboratory.add_host("arm", laboratory.add_site("hall", Access.PORT_RESTRICTED))
    address, lab = border.lease().address.partition("/")[0], tmp_path / "lab"

    def said() -> str:
        return "".join(each.read_text() for each in tmp_path.glob("*.log"))[-4_000:]

    with contextlib.ExitStack() as stack:
        first = created_domain(stack, border, address, lab)
        tokens = [first, gdp("domain", "token", "lab", "--directory", str(lab), "--role", "leaf")]
        until(lambda: "listening on TCP port" in (tmp_path / "border.log").read_text(), said, PATIENCE_S)
        for host, token in zip((robot, arm), tokens, strict=True):
            home = str(tmp_path / host.label)
            join = ("join", "--label", host.label, "--directory", home, "--no-systemd")
            stack.enter_context(running(host, tmp_path, *join, answer=token))
        until(lambda: up(lab) == {"robot", "arm"}, said, PATIENCE_S)
        until(lambda: "border" in up(tmp_path / "robot"), said, PATIENCE_S)
        logs = [tmp_path / f"{each.label}.log" for each in (robot, arm)]
        until(lambda: all("tunnels are up: border" in each.read_text() for each in logs), said, PATIENCE_S)
        until(lambda: is_found(switch_name(tmp_path / "arm"), tmp_path / "robot" / "switch"), said, PATIENCE_S)
        rows = {
            each["label"]: each for each in json.loads(gdp("domain", "ls", "lab", "--directory", str(lab), "--json"))
        }
        assert rows.keys() == {"border", "robot", "arm"}
        (path,) = traced("two WireGuard tunnels", switch_name(tmp_path / "arm"), tmp_path / "robot" / "switch")
        assert [hop["label"] for hop in path["hops"]] == ["robot", "border", "arm"]
        assert [hop["in"]["label"] for hop in path["hops"][1:]] == ["robot", "border"]
        assert {path["hops"][0]["out"]["port"], path["hops"][1]["in"]["port"]} <= devices(tmp_path / "robot") | devices(
            lab
        )
        gdp("domain", "remove", "lab", "robot", "--directory", str(lab))
        until(lambda: {each["label"] for each in links(lab)} == {"arm"}, said, PATIENCE_S)


def test_a_machine_that_joined_as_a_holder_serves_its_store_once_the_owner_lets_it(
    laboratory: Laboratory, tmp_path: Path
) -> None:
    border = laboratory.add_host("border", laboratory.add_site("dc", Access.PUBLIC))
    archive = laboratory.add_host("archive", laboratory.add_site("home", Access.PORT_RESTRICTED))
    address, lab, home = border.lease().address.partition("/")[0], tmp_path / "lab", tmp_path / "archive"

    def said() -> str:
        return "".join(each.read_text() for each in tmp_path.glob("*.log"))[-4_000:]

    with contextlib.ExitStack() as stack:
        created_domain(stack, border, address, lab)
        token = gdp("domain", "token", "lab", "--directory", str(lab), "--role", "holder")
        until(lambda: "listening on TCP port" in (tmp_path / "border.log").read_text(), said, PATIENCE_S)
        join = ("join", "--label", "archive", "--directory", str(home), "--no-systemd")
        stack.enter_context(running(archive, tmp_path, *join, answer=token))
        until(lambda: up(home) == {"border"}, said, PATIENCE_S)
        metadata = Metadata({"kind": "service", "name": "store"})
        delegation = delegate(lab / "owner", home / "store" / CARD, metadata, [Right.SERVE])
        install_delegation(home / "store", delegation)
        until(lambda: "serves store; Ctrl-C ends it" in said(), said, PATIENCE_S)
        until(lambda: is_found(delegation.name.to_text(), lab / "switch"), said, PATIENCE_S)
