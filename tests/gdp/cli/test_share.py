"""``gdp expose``, ``gdp import`` and ``gdp share``, as called by a person, through a folder that the machines share."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from gdp.cli.gdp import main
from gdp.errors import StoreError
from gdp.sharing.exchange import FolderExchange
from gdp.stores.issue import succeed_owner
from gdp.stores.keyring import CARD, OWNER_KEY, OWNER_SALT, load_card, load_salt
from proxy.config.config import ProxyConfig
from tests.gdp.sharing.machines import IMAGE, STRING, Machine, Site

Run = Callable[..., "tuple[int, str, str]"]


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    monkeypatch.chdir(tmp_path)
    return Site(tmp_path)


@pytest.fixture
def robot(site: Site) -> Machine:
    return joined(site, "robot")


@pytest.fixture
def server(site: Site) -> Machine:
    return joined(site, "server")


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def run(*words: str) -> tuple[int, str, str]:
        """Return exit code, output and errors of ``gdp COMMAND HOST ...``."""
        command, host, *rest = words
        with pytest.raises(SystemExit) as leaving:
            main([command, *rest, "--directory", host, "--exchange", "common"])
        shown = capsys.readouterr()
        return int(leaving.value.code or 0), shown.out, shown.err

    return run


def joined(site: Site, label: str) -> Machine:
    machine = site.add(label)
    FolderExchange(site.folder / "common", load_card(machine.folder / "proxy" / CARD))
    return machine


def test_two_commands_share_a_topic(robot: Machine, server: Machine, run: Run) -> None:
    with ExitStack() as stack:
        robot.start(stack)
        server.start(stack)
        code, text, _ = run("expose", "robot", "/camera/image", "--type", IMAGE, "--to", "server")
        assert (code, text.splitlines()[0]) == (0, "/camera/image: now")
        code, text, _ = run("import", "server", "/camera/image", "--from", "robot")
        first, head, row = text.splitlines()
        assert (code, first, head.split()) == (
            0,
            "/camera/image: now",
            ["name", "type", "from", "rights", "until", "state"],
        )
        assert (row.split()[:4], row.split()[-1]) == (["/camera/image", IMAGE, "robot", "read"], "used")
    assert (robot.rights(), server.rights()) == ({"/camera/image": {"publish"}}, {"/camera/image": {"read"}})


def test_a_pattern_waits_for_what_the_graph_shows(robot: Machine, server: Machine, run: Run) -> None:
    robot.graph.append(("topic", "/camera/image", IMAGE))
    with ExitStack() as stack:
        robot.start(stack)
        code, text, _ = run("expose", "robot", "/camera/**", "--to", "server", "--json")
    result = json.loads(text)
    assert (code, result["applied"], result["problems"]) == (0, "now", [])
    assert [(each["node"], each["rights"]) for each in result["delegated"]] == [
        ("robot", ["publish"]),
        ("server", ["read"]),
    ]


def test_a_name_that_no_local_node_shows_is_exposed_later(robot: Machine, server: Machine, run: Run) -> None:
    with ExitStack() as stack:
        robot.start(stack)
        assert run("expose", "robot", "/camera/**", "--to", "server", "--wait", "0")[:2] == (
            0,
            "/camera/**: as soon as a local node shows it\n",
        )


def test_without_a_running_proxy_the_text_says_when_a_rule_is_applied(
    robot: Machine, server: Machine, run: Run
) -> None:
    code, text, _ = run("expose", "robot", "/camera/image", "--type", IMAGE, "--to", "server")
    assert (code, text.splitlines()[0]) == (0, "/camera/image: at the next start of the proxy")


def test_lists_show_offers_and_what_is_shared(robot: Machine, server: Machine, run: Run) -> None:
    run("share", "robot", "/goal", "--type", STRING, "--with", "server", "--publish")
    offers = listed(run("import", "server", "--list", "--json"))["offers"]
    assert [(each["name"], each["from"], each["rights"], each["accepted"]) for each in offers] == [
        ("/goal", "robot", ["publish"], False)
    ]
    shared = listed(run("share", "robot", "--list", "--json"))["shared"]
    assert [(each["name"], each["node"], each["state"]) for each in shared] == [("/goal", "server", "delivered")]
    assert "/goal  std_msgs/msg/String  server  publish" in run("share", "robot", "--list")[1]
    assert "/goal  std_msgs/msg/String  robot  publish" in run("import", "server", "--list")[1]


def test_a_second_robots_equal_name_is_listed_as_not_used_with_what_to_do(
    site: Site, robot: Machine, server: Machine, run: Run
) -> None:
    arm = site.add("arm")
    FolderExchange(site.folder / "common", load_card(arm.folder / "proxy" / CARD))
    run("expose", "robot", "/state", "--type", STRING, "--to", "server")
    run("import", "server", "/*")
    run("expose", "arm", "/state", "--type", STRING, "--to", "server")
    code, text, errors = run("import", "server", "/state")
    why = "not used: another owner's /state is in use; state prefix: in the proxy.yaml of arm"
    _, _, first, second = text.splitlines()
    assert (first.endswith("  used"), second.endswith(f"  {why}")) == (True, True)
    assert (code, errors) == (1, "error: /state: 1 of the names above are not in force\n")
    assert run("import", "server", "--list")[1].splitlines() == text.splitlines()[1:]
    assert [each["state"] for each in listed(run("import", "server", "--list", "--json"))["offers"]] == ["used", why]


def test_what_an_import_lists_as_json_is_what_it_lists_as_text(
    site: Site, robot: Machine, server: Machine, run: Run
) -> None:
    arm = site.add("arm")
    FolderExchange(site.folder / "common", load_card(arm.folder / "proxy" / CARD))
    for machine in ("robot", "arm"):
        run("expose", machine, "/state", "--type", STRING, "--to", "server")
    code, text, _ = run("import", "server", "/state", "--json")
    states = [each["state"].partition(":")[0] for each in json.loads(text)["offers"]]
    assert (code, states) == (1, ["used", "not used"])


def test_a_name_that_the_other_machine_no_longer_exposes_is_listed_as_withdrawn(
    robot: Machine, server: Machine, run: Run
) -> None:
    words, state = ("expose", "robot", "/state", "--type", STRING, "--to", "server"), "withdrawn: robot no longer"
    with ExitStack() as stack:
        robot.start(stack)
        server.start(stack)
        run(*words)
        run("import", "server", "/*")
        assert run("expose", "robot", "/state", "--remove")[:2] == (0, "/state: now\n")
        (offer,) = listed(run("import", "server", "--list", "--json"))["offers"]
        assert (offer["accepted"], offer["state"].startswith(state), server.rules("import")) == (True, True, [])
        code, text, errors = run("import", "server", "/state")
        assert (code, text.splitlines()[0]) == (1, "/state: as soon as a node offers it")
        assert errors == "error: /state: 1 of the names above are not in force\n"
        run(*words)
        (offer,) = listed(run("import", "server", "--list", "--json"))["offers"]
        assert (offer["state"], server.rules("import")) == ("used", [("/state", STRING)])


def test_a_delegation_that_cannot_be_delivered_yet_ends_the_command_with_1(
    robot: Machine, server: Machine, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise StoreError("the folder is not there")

    monkeypatch.setattr(FolderExchange, "send", fail)
    code, text, errors = run("expose", "robot", "/state", "--type", STRING, "--to", "server")
    assert (code, text.splitlines()[-1].split()[-3:]) == (1, ["waits", "for", "delivery"])
    assert errors.endswith("error: /state: 1 of the names above are not in force\n")


def test_a_name_is_taken_back_through_the_switch_of_the_machine(robot: Machine, server: Machine, run: Run) -> None:
    run("share", "robot", "/goal", "--type", STRING, "--with", "server")
    (robot.folder / "revoked").mkdir()
    switch = "identity: proxy\ndomain: {root: proxy/root.crt}\n"
    (robot.folder / "switch.yaml").write_text(switch)
    code, _, errors = run("share", "robot", "/goal", "--revoke", "server")
    assert (code, "a revocation needs a folder; state revocations: DIR" in errors) == (2, True)
    (robot.folder / "switch.yaml").write_text(f"{switch}revocations: revoked\n")
    code, _, errors = run("share", "robot", "/goal", "--revoke", "server")
    assert (code, errors) == (0, "gdp: the switch does not run: the revocation spreads when it starts\n")
    assert len(list((robot.folder / "revoked").iterdir())) == 1
    assert listed(run("share", "robot", "--list", "--json"))["shared"][0]["state"] == "revoked"
    assert listed(run("import", "server", "--list", "--json"))["offers"] == []


def test_a_machine_without_an_owner_makes_one_unless_the_command_fails(
    robot: Machine, server: Machine, run: Run
) -> None:
    for file in robot.owner.iterdir():
        file.unlink()
    robot.owner.rmdir()
    assert run("expose", "robot", "/camera/**", "--to", "nowhere")[0] == 2
    assert not robot.owner.exists()
    assert run("expose", "robot", "/camera/**", "--to", "server")[0] == 0
    assert (robot.owner / OWNER_KEY).exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["expose", "robot", "/x"], "error: expose: state --to NODE, or --from NODE for a name"),
        (["expose", "robot", "/x", "--to", "nowhere"], "error: 'nowhere': no such node or group in the domain; there"),
        (
            ["expose", "robot", "/x", "--to", "server", "--kind", "param"],
            "error: 'param': expected topic, service, action or node",
        ),
        (["expose", "robot", "/x", "--remove"], "error: /x is not exposed by 'gdp expose'"),
        (["expose", "nowhere", "/x", "--to", "server"], "error: nowhere: no proxy.yaml is here; name the machine's"),
        (["import", "robot"], "error: import: state a NAME, or --list"),
        (["import", "robot", "x"], "error: 'x': expected a full ROS name, such as /camera/image, or a pattern"),
        (["import", "robot", "/x", "--remove"], "error: /x is not accepted; 'gdp import --list' shows what is"),
        (["share", "robot", "/x"], "error: share: state a NAME and --with NODE or --revoke NODE; or --list"),
        (["share", "robot", "/x", "--with", "server"], "error: /x: its type is not known here: state --type"),
        (
            ["share", "robot", "/x", "--with", "server", "--serve"],
            "error: share: --publish is for a topic, --serve for",
        ),
        (
            ["share", "robot", "/x", "--revoke", "server"],
            "error: /x is not shared with server; 'gdp share --list' shows",
        ),
    ],
)
def test_a_wrong_command_is_refused_with_one_sentence(
    robot: Machine, server: Machine, run: Run, words: list[str], expected: str
) -> None:
    before = {path for path in robot.folder.rglob("*") if path.is_file()}
    code, text, errors = run(*words)
    assert (code, text, errors.count("\n")) == (2, "", 1)
    assert errors.startswith(expected)
    assert {path for path in robot.folder.rglob("*") if path.is_file()} == before


def listed(done: tuple[int, str, str]) -> dict[str, Any]:
    """Return the JSON object of a command that succeeded."""
    code, text, errors = done
    assert (code, errors) == (0, "")
    result: dict[str, Any] = json.loads(text)
    return result


def test_a_robot_with_a_prefix_shares_its_names_under_it(site: Site, server: Machine, run: Run) -> None:
    robot = site.add("robot", "prefix: robot1\n")
    FolderExchange(site.folder / "common", load_card(robot.folder / "proxy" / CARD))
    robot.graph.append(("topic", "/camera/image", IMAGE))
    with ExitStack() as stack:
        robot.start(stack)
        server.start(stack)
        code, text, error = run("expose", "robot", "/camera/**", "--to", "server")
        assert (code, error) == (0, "")
        assert f"/robot1/camera/image  {IMAGE}  server  read" in text
        run("import", "server", "/robot1/camera/image")
    assert robot.rules("expose") == [("/camera/**", "")]
    assert server.rules("import") == [("/robot1/camera/image", IMAGE)]


def test_a_robot_with_a_prefix_takes_names_with_it_and_others_as_they_are(
    site: Site, server: Machine, run: Run
) -> None:
    robot = site.add("robot", "prefix: robot1\n")
    FolderExchange(site.folder / "common", load_card(robot.folder / "proxy" / CARD))
    with ExitStack() as stack:
        robot.start(stack)
        server.start(stack)
        for name in ("/robot1/cmd", "/fleet/goal"):
            run("expose", "server", name, "--type", STRING, "--to", "robot")
            run("import", "robot", name)
    assert robot.config is not None
    rules = [(rule.local, rule.overlay_metadata["name"]) for rule in robot.config.imports]
    assert rules == [("/cmd", "/robot1/cmd"), ("/fleet/goal", "/fleet/goal")]


@pytest.mark.parametrize("more", [[], ["--plain-name"]])
def test_an_owner_that_expose_makes_has_a_salt_which_no_output_shows(
    robot: Machine, server: Machine, run: Run, more: list[str]
) -> None:
    shutil.rmtree(robot.owner)
    code, text, error = run("expose", "robot", "/camera/image", "--type", IMAGE, "--to", "server", *more, "--json")
    assert (code, error) == (0, "")
    salt = load_salt(robot.owner)
    assert len(salt) >= 16
    assert (robot.owner / OWNER_SALT).stat().st_mode & 0o777 == 0o600
    assert salt not in text + run("share", "robot", "--list", "--json")[1]
    (rule,) = ProxyConfig.load(robot.path).expose
    assert rule.metadata == ({} if more else {"salt": salt})


def test_a_successor_of_an_owner_shares_names_with_the_same_salt(robot: Machine, tmp_path: Path) -> None:
    succeed_owner(robot.owner, tmp_path / "heir", (), days=1)
    assert load_salt(tmp_path / "heir") == load_salt(robot.owner) != ""
