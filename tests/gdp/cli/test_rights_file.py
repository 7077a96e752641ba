"""``gdp delegate rights``: one file states what single commands would delegate."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp.cli.rights_file import RightsFile
from gdp.config.schema import load
from gdp.stores.issue import delegate, install_delegation
from gdp.stores.keyring import load_delegation, load_delegations, save_delegation
from gdp.trust.right import Right
from tests.pages import ROOT, blocks

RIGHTS = "owner: owner\nrights:\n  - {name: greeting, publish: [robot], read: [server/node.card]}\n"
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def gdp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command next to a domain with two nodes."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> tuple[int, str, str]:
        code = 0
        try:
            main(words)
        except SystemExit as leaving:
            code = int(leaving.code or 0)
        output = capsys.readouterr()
        return code, output.out, output.err

    assert run("lab", "--program", "robot", "server", "edge")[0] == 0
    Path("rights.yaml").write_text(RIGHTS)
    return run


def _states(gdp: Run, *more: str) -> list[str]:
    code, out, err = gdp("delegate", "rights", "rights.yaml", "--json", *more)
    assert (code, err) == (0, "")
    return [row["state"] for row in json.loads(out)["rights"]]


def _rights(node: str) -> list[set[str]]:
    return [{right.value for right in each.rights} for each in load_delegations(Path(node, "delegations"))]


def test_the_file_of_the_tutorial_gives_what_its_programs_need(gdp: Run) -> None:
    (shown,) = [each for each in blocks(ROOT / "docs/tutorials/library.md") if each.title == "rights.yaml"]
    Path("rights.yaml").write_text(shown.text)
    code, out, _ = gdp("delegate", "rights", "rights.yaml")
    head, *rows = [line.split() for line in out.splitlines()]
    assert (code, head) == (0, ["state", "name", "kind", "rights", "node", "until", "file"])
    assert [row[:5] for row in rows] == [
        ["made", "greeting", "topic", "publish", "robot"],
        ["made", "greeting", "topic", "read", "server"],
        ["made", "reverse", "service", "serve", "server"],
        ["made", "reverse", "service", "serve", "edge"],
        ["made", "reverse", "service", "call", "robot"],
    ]
    for *_, file in rows:
        assert install_delegation(Path(file).parents[1], load_delegation(Path(file)), force=True) == Path(file)


def test_a_second_time_changes_nothing_unless_it_is_to_renew(gdp: Run) -> None:
    assert _states(gdp) == ["made", "made"]
    (file,) = Path("robot/delegations").iterdir()
    before = file.read_bytes()
    assert (_states(gdp), file.read_bytes()) == (["kept", "kept"], before)
    assert (_states(gdp, "--renew"), file.read_bytes() == before) == (["made", "made"], False)


def test_a_check_shows_what_is_missing_and_changes_nothing(gdp: Run) -> None:
    assert (_states(gdp, "--check"), _rights("robot")) == (["missing", "missing"], [])
    _states(gdp)
    assert _states(gdp, "--check") == ["kept", "kept"]


def test_rights_and_epochs_that_come_later_leave_those_of_before(gdp: Run) -> None:
    _states(gdp)
    Path("rights.yaml").write_text("owner: owner\nrights: [{name: greeting, read: [robot], epochs: [2]}]\n")
    assert _states(gdp) == ["made"]
    (held,) = load_delegations(Path("robot/delegations"))
    assert (_rights("robot"), sorted(held.grants)) == ([{"publish", "read"}], [0, 2])


def test_an_expired_delegation_is_made_again(gdp: Run) -> None:
    meaning = load(RightsFile, Path("rights.yaml")).rights[0].meaning
    old = delegate(Path("owner"), Path("robot/node.card"), meaning, [Right.PUBLISH], days=1, unix_s=1e9)
    save_delegation(Path("robot/delegations"), old)
    assert _states(gdp) == ["made", "made"]


def test_a_card_alone_gets_a_folder_of_delegations_to_send(gdp: Run) -> None:
    shutil.copy("edge/node.card", "far.card")
    Path("rights.yaml").write_text("owner: owner\nrights: [{kind: service, name: reverse, serve: [far.card]}]\n")
    assert _states(gdp) == ["made"]
    (file,) = Path("far.delegations").glob("*.delegation")
    assert gdp("delegate", "install", str(file), "--node", "edge")[0] == 0


def test_the_name_is_that_of_the_single_command(gdp: Run) -> None:
    Path("salt").write_text("unguessable")
    Path("salt").chmod(0o600)
    Path("rights.yaml").write_text(
        "owner: owner\nrights: [{name: /scan, type: sensor_msgs/msg/LaserScan, metadata: {author: lab, pin: 7},"
        " salt_file: salt, read: [robot]}]\n"
    )
    _states(gdp)
    words = "--kind topic --name /scan --type sensor_msgs/msg/LaserScan --author lab --pin 7 --salt-file salt"
    _, name, _ = gdp("name", *words.split(), "--owner", "owner/owner.pub")
    assert [each.name.to_text() for each in load_delegations(Path("robot/delegations"))] == [name.strip()]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("{name: a, reed: [robot]}", "4:15: rights[0].reed: unknown key; expected one of kind, name, type, "),
        ("{name: a, read: [robo]}", "4:22: rights[0].read[0]: expected a node's directory or its card: robo: No such"),
        ("{name: a, read: robot}", "4:21: rights[0].read: expected a list, not 'robot'"),
        ("{name: a, read: [owner]}", "4:22: rights[0].read[0]: expected a node's directory or its card: owner/node"),
        ("{name: a, serve: [robot]}", "4:22: rights[0].serve: only services and actions have this"),
        ("{kind: action, name: a, read: [robot]}", "4:35: rights[0].read: only topics have this"),
        ("{kind: topi, name: a}", "4:12: rights[0].kind: expected 'topic', 'service', 'action' or 'node', not 'topi'"),
        ("{name: a}", "4:5: rights[0]: a: state nodes under publish, read, serve or call"),
        ("{name: a, read: [robot], days: 0}", "4:36: rights[0].days: expected greater than 0, not 0"),
        ("{name: a, read: [robot], epochs: [-1]}", "4:39: rights[0].epochs[0]: expected greater than or equal to 0"),
        ("{name: a, read: [robot], metadata: {name: b}}", "4:5: rights[0]: metadata: name: a key of its own has this"),
        ("{name: a, read: [robot], metadata: {salt: b}}", "4:5: rights[0]: metadata: salt: a key of its own has this"),
        ("{name: a, read: [robot]}\n  - {name: a, publish: [edge]}", "5:5: rights[1]: a stands twice; state all its"),
    ],
)
def test_a_wrong_file_is_refused_with_the_line_before_anything_is_made(gdp: Run, text: str, error: str) -> None:
    Path("rights.yaml").write_text(f"# rights\nowner: owner\nrights:\n  - {text}\n")
    code, out, err = gdp("delegate", "rights", "rights.yaml")
    assert (code, out, _rights("robot")) == (2, "", [])
    assert err.startswith(f"error: rights.yaml:{error}")


def test_a_card_of_another_domain_is_refused_where_a_root_is_stated(gdp: Run) -> None:
    assert gdp("domain", "init", "other", "--label", "other")[0] == 0
    Path("rights.yaml").write_text(f"root: other/root.crt\n{RIGHTS}")
    code, _, err = gdp("delegate", "rights", "rights.yaml")
    assert (code, err.startswith("error: robot/node.card: "), _rights("robot")) == (2, True, [])
