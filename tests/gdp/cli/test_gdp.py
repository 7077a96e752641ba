"""``gdp`` command, as called by a person or a script."""

from __future__ import annotations

import json
import re
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.core import TyperGroup
from typer.main import get_command

from gdp.cli.extension import placeholder
from gdp.cli.gdp import app, main
from gdp.crypto.statements import StatementType, parse
from gdp.metadata import Metadata
from gdp.stores.keyring import load_delegations, load_owner
from gdp.trust.revocation import Revocation


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str


Run = Callable[..., Outcome]


@pytest.fixture
def gdp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command in an empty directory."""
    monkeypatch.chdir(tmp_path)

    def run(line: str, *more: str) -> Outcome:
        code = 0
        try:
            main([*line.split(), *more])
        except SystemExit as leaving:
            code = int(leaving.code or 0)
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return run


@pytest.fixture
def keys(gdp: Run) -> None:
    """Domain, a node of it, and an owner."""
    for line in (
        "domain init school --label school",
        "keygen node robot --role proxy --label robot --meta site=roof",
        "cert issue --domain school --node robot --role proxy --label robot",
        "keygen owner lab",
    ):
        assert gdp(line).code == 0


CAMERA = "--kind topic --name /camera/image --type sensor_msgs/msg/Image --author lab"
DELEGATE = f"delegate name --owner lab --card robot/node.card --right publish {CAMERA} --out cam.delegation"


def test_the_name_of_a_topic_is_printed_alone(gdp: Run, keys: None) -> None:
    done = gdp(f"name {CAMERA} --owner lab/owner.pub")
    metadata = {"kind": "topic", "name": "/camera/image", "type": "sensor_msgs/msg/Image", "author": "lab"}
    owner = load_owner(Path("lab")).key.public.compressed
    assert done == Outcome(0, Metadata(metadata).name(owner).to_text() + "\n", "")


def test_json_says_what_the_name_is_made_of(gdp: Run) -> None:
    done = gdp("name --kind topic --name /a --pin 7 --meta site=roof --json")
    metadata = Metadata({"kind": "topic", "name": "/a", "pin": 7, "site": "roof"})
    assert json.loads(done.out) == {
        "name": metadata.name().to_text(),
        "short": metadata.name().short,
        "digest": metadata.digest().hex(),
        "owner": None,
        "metadata": dict(metadata),
    }


def test_the_way_from_nothing_to_a_delegation(gdp: Run, keys: None) -> None:
    done = gdp(f"{DELEGATE} --right read --epochs 0,2-3 --root school/root.crt --json")
    assert done.code == 0
    said = json.loads(done.out)
    assert (said["rights"], said["epochs"], said["label"]) == (["publish", "read"], [0, 2, 3], "robot")
    assert gdp("delegate install cam.delegation --node robot").code == 0
    (found,) = load_delegations(Path("robot/delegations"))
    assert found.name.to_text() == said["name"]


def test_the_way_of_a_node_that_is_elsewhere(gdp: Run, keys: None) -> None:
    assert gdp("keygen node far --role switch --label far").code == 0
    assert gdp("cert issue --domain school --request far/node.csr --role switch --label far --out far.crt").code == 0
    assert gdp("cert install far --cert far.crt --root school/root.crt").code == 0
    said = json.loads(gdp("cert show far/node.crt --root school/root.crt --json").out)
    assert json.loads(gdp("cert show far --json").out) == said  # the directory of a node is enough
    assert (said["role"], said["label"]) == ("switch", "far")


def test_an_rtcert_is_written(gdp: Run, keys: None) -> None:
    assert gdp(f"delegate route --node robot --switch {'ab' * 32} --out robot.rtcert").code == 0
    statement = parse(Path("robot.rtcert").read_bytes())
    assert statement.type is StatementType.RTCERT
    assert statement.fields["switch"] == bytes.fromhex("ab" * 32)


def test_revocations_are_written_for_memberships_and_delegations(gdp: Run, keys: None) -> None:
    gdp(DELEGATE)
    assert gdp("delegate revoke cam.delegation --owner lab --out cam.revoke").code == 0
    assert gdp("cert revoke robot/node.crt --domain school --out robot.revoke").code == 0
    for name in ("cam.revoke", "robot.revoke"):
        Revocation.from_statement(parse(Path(name).read_bytes()))


def test_files_with_secrets_are_private(gdp: Run, keys: None) -> None:
    gdp(DELEGATE)
    found = {path.name for path in Path().rglob("*") if path.is_file() and stat.S_IMODE(path.stat().st_mode) == 0o600}
    logs = {"issued.jsonl", "audit.jsonl"}
    assert found == {"root.key", "owner.key", "master.key", "node.key", "kem.key", "cam.delegation"} | logs


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("name --kind planet", "kind"),
        ("name --kind topic --owner absent.pub", "absent.pub"),
        ("name --kind topic --owner school/root.crt", "root.crt"),
        ("name --kind topic --meta nothing", "key=value"),
        ("name --kind topic --meta a=1 --meta a=2", "twice"),
        ("name --kind topic --name /a --meta name=/b", "twice"),
        ("domain init school --label school", "--force"),
        ("keygen owner lab", "--force"),
        ("keygen node robot --role proxy --label robot", "--force"),
        ("keygen node x --role proxy --label x --meta kind=rib", "role and label"),
        ("cert issue --domain school --node robot --role proxy --label robot", "--force"),
        ("cert issue --domain school", "--request"),
        ("cert issue --domain school --request robot/node.csr", "--out"),
        ("cert issue --domain school --request robot/node.crt --out x", "node.crt"),
        ("cert issue --domain absent --node robot --role proxy --label robot", "absent"),
        ("cert show robot/node.key --root school/root.crt", "node.key"),
        ("cert show robot/node.crt --root robot/node.crt", "node.crt"),
        ("domain show robot/node.crt", "node.crt"),
        (f"{DELEGATE} --epochs 3-1", "--epochs"),
        (f"{DELEGATE} --epochs 65536", "--epochs"),
        (f"{DELEGATE} --epochs x", "--epochs"),
        (f"{DELEGATE} --right fly", "--right"),
        (f"{DELEGATE} --right attach", "publish, serve, call and read"),
        (f"{DELEGATE} --card robot/node.crt", "node.crt"),
        ("delegate install robot/node.json --node robot", "node.json"),
        ("delegate route --node robot --switch 12 --out x", "64 hex digits"),
    ],
)
def test_wrong_input_is_named_and_exits_with_2(gdp: Run, keys: None, line: str, complaint: str) -> None:
    done = gdp(line)
    assert (done.code, done.out) == (2, "")
    assert re.search(rf"^error: .*{re.escape(complaint)}", done.err, re.MULTILINE), done.err


@pytest.mark.parametrize("right", ["serve", "call"])
@pytest.mark.parametrize("kind", ["service", "action"])
def test_a_service_or_an_action_is_delegated_to_serve_or_to_call(gdp: Run, keys: None, right: str, kind: str) -> None:
    done = gdp(
        f"delegate name --owner lab --card robot/node.card --right {right} --kind {kind} --name /plan"
        " --out p.delegation --json"
    )
    assert (done.code, json.loads(done.out)["rights"]) == (0, [right])
    assert gdp("delegate install p.delegation --node robot").code == 0


@pytest.mark.parametrize("line", ["name --kind", "name --kind topic --pin x", "nonsense", "keygen node x --role king"])
def test_wrong_usage_exits_with_2(gdp: Run, line: str) -> None:
    assert gdp(line).code == 2


def test_a_key_that_others_can_read_is_not_used(gdp: Run, keys: None) -> None:
    Path("lab/owner.key").chmod(0o640)
    done = gdp(DELEGATE)
    assert done.code == 2
    assert "chmod 600 lab/owner.key" in done.err


def test_a_card_of_another_domain_is_refused_where_a_root_is_given(gdp: Run, keys: None) -> None:
    gdp("domain init cloud --label cloud")
    done = gdp(f"{DELEGATE} --root cloud/root.crt")
    assert (done.code, Path("cam.delegation").exists()) == (2, False)
    assert "wrong-domain" in done.err


def leaves(command: Any, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Return the commands that are there, without those whose extension is absent."""
    if not isinstance(command, TyperGroup):
        return [path] if command.callback.__name__ != placeholder.__name__ else []
    context = typer.Context(command)
    inner = [(name, command.get_command(context, name)) for name in command.list_commands(context)]
    return [leaf for name, sub in inner for leaf in leaves(sub, (*path, name))]


@pytest.mark.parametrize("path", leaves(get_command(app)), ids=" ".join)
def test_every_command_has_help_with_an_example_and_json(gdp: Run, path: tuple[str, ...]) -> None:
    done = gdp("", *path, "--help")
    assert done.code == 0
    assert re.search(rf"Examples?:\s+gdp {' '.join(path)}\s", done.out)
    assert "--json" in done.out


def test_the_help_of_every_group_gives_each_command_its_name(gdp: Run) -> None:
    for path in {leaf[:-1] for leaf in leaves(get_command(app))}:
        out = gdp("", *path, "--help").out
        names = {leaf[len(path)] for leaf in leaves(get_command(app)) if leaf[: len(path)] == path}
        assert names == {name for name in names if re.search(rf"(?m)^\W*{name}\s", out)}


@pytest.mark.parametrize(("group", "commands"), [("unit", {"install", "remove", "status"}), ("service", {"call"})])
def test_units_of_systemd_and_calls_of_services_are_commands_of_their_own(group: str, commands: set[str]) -> None:
    assert {leaf[1] for leaf in leaves(get_command(app)) if leaf[0] == group} == commands
