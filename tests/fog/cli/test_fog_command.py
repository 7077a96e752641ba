"""``fog`` command with a prepared state folder: texts, JSON, exit codes and refusals."""

from __future__ import annotations

import json
import re
import socket
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner, Result

from fog.bootstrap.members import metadata_of
from fog.cli import launch, logs, options, status
from fog.cli.app import app
from fog.cluster import CloudNode, ClusterPlan, RobotNode
from fog.site import Site, open_site
from fog.supervisor.core.record import Outcome, stage
from fog.supervisor.journal import FINAL_LOGS, Journal
from gdp.stores.keyring import OWNER_SALT, load_salt
from tests.fog.supervisor.machines import record, serving
from tests.fog.supervisor.test_journal import PLAN
from tests.pages import ROOT

VERBS = ["launch", "ls", "status", "scale up", "scale down", "logs", "ssh", "cost", "plan", "down"]
VERBS += ["supervise", "wheels"]
Run = Callable[..., Result]


@pytest.fixture
def fog(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.setenv("FOG_STATE", str(tmp_path / "state"))
    monkeypatch.setattr(options, "ensure", lambda site: False)
    monkeypatch.chdir(tmp_path)
    return lambda *words: CliRunner().invoke(app, [*words])


@pytest.fixture
def journal(tmp_path: Path, fog: Run) -> Iterator[Journal]:
    journal = Journal(tmp_path / "state" / "journal.sqlite3")
    yield journal
    journal.close()


def up(journal: Journal, plan: ClusterPlan = PLAN) -> None:
    now_s = time.time()
    journal.put_cluster(plan, now_s)
    for each in (serving("m1"), record("m2", "west")):
        journal.put(replace(each, asked_unix_s=now_s - 1_800), now_s, "requested", "east")


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help_with_an_example(fog: Run, verb: str) -> None:
    said = fog(*verb.split(), "--help").output
    assert f"fog {verb}" in said.partition("Example")[2]


def test_where_nothing_is_up_that_is_said(fog: Run) -> None:
    assert "no cluster is up" in fog("ls").output
    assert json.loads(fog("ls", "--json").output) == []
    result = fog("status")
    assert (result.exit_code, "fog launch" in result.output) == (2, True)


def test_machines_and_their_stage_are_reported(fog: Run, journal: Journal) -> None:
    up(journal)
    reported = json.loads(fog("status", "--json").output)
    assert (reported["wanted"], reported["serving"]) == (2, 1)
    assert [(each["name"], each["stage"]) for each in reported["members"]] == [("m1", "serving"), ("m2", "booting")]
    assert "serving" in fog("status").output


def test_the_machine_that_is_the_gateway_is_reported(fog: Run, journal: Journal) -> None:
    journal.put_cluster(PLAN, time.time())
    for each in (replace(serving("m1"), gateway="edge"), serving("m2")):
        journal.put(each, time.time())
    gone = replace(serving("m3"), gateway="edge").ended(Outcome.PREEMPTED, "killed", time.time())
    journal.put(gone, time.time())
    reported = json.loads(fog("status", "--all", "--json").output)
    assert [each["gateway"] for each in reported["members"]] == ["edge", None, None]
    (line,) = (each for each in fog("status").output.splitlines() if each.startswith("m1"))
    assert line.split()[:3] == ["m1", "serving", "edge"]


@pytest.mark.parametrize("kind", ["dedicated", "replica"])
def test_a_dry_run_says_which_gateway_a_machine_is_behind(fog: Run, kind: str) -> None:
    words = ["launch", str(ROOT / "examples" / "echo.launch.py"), "--dry-run", "--gateway", kind]
    is_replica = kind == "replica"
    reported = json.loads(fog(*words, "--json").output)
    assert {each["gateway"]["replica"] for each in reported["machines"]} == {is_replica}
    assert ("gateway gateway: one of these machines" in fog(*words).output) is is_replica


def test_where_a_file_states_the_site_no_option_does(fog: Run, tmp_path: Path) -> None:
    for folder in ("domain", "owner"):
        (tmp_path / folder).mkdir()
    (tmp_path / "fog.yaml").write_text("domain: domain\nowner: owner\n")
    words = ["launch", str(ROOT / "examples" / "echo.launch.py"), "--dry-run", "--gateway", "replica"]
    result = fog(*words)
    assert (result.exit_code, "set 'topology' there" in result.output) == (2, True)


def test_cost_is_price_by_time(fog: Run, journal: Journal) -> None:
    up(journal)
    (reported,) = json.loads(fog("cost", "--json").output)
    assert reported["usd_ever"] == pytest.approx(2 * 0.1 * 0.5, rel=0.02)
    assert reported["usd_per_hour"] == pytest.approx(0.2)


def test_events_are_printed_as_lines_of_json(fog: Run, journal: Journal) -> None:
    up(journal)
    events = [json.loads(line)["what"] for line in fog("status", "--events", "--json").output.splitlines()]
    assert events == ["wanted", "requested", "requested"]


def test_the_last_replica_is_not_scaled_away(fog: Run, journal: Journal) -> None:
    up(journal)
    result = fog("scale", "down", "2")
    assert (result.exit_code, "fog down c" in result.output) == (2, True)
    assert len(journal.cluster("c").plan.machines) == 2


def test_a_dry_run_shows_the_price_and_changes_nothing(fog: Run, journal: Journal) -> None:
    up(journal)
    assert json.loads(fog("scale", "up", "--dry-run", "--json").output)["usd_per_hour"] > 0
    reported = json.loads(fog("launch", str(ROOT / "examples" / "echo.launch.py"), "--dry-run", "--json").output)
    assert (len(reported["machines"]), reported["usd_per_hour"] > 0) == (2, True)
    assert [each.plan.name for each in journal.clusters()] == ["c"]


def test_of_several_clusters_one_must_be_named(fog: Run, journal: Journal) -> None:
    up(journal)
    up(journal, replace(PLAN, name="d"))
    result = fog("status")
    assert (result.exit_code, "c, d" in result.output) == (2, True)
    assert fog("status", "d").exit_code == 0


def test_a_wrong_key_of_fog_yaml_is_reported_with_its_position(fog: Run, tmp_path: Path) -> None:
    (tmp_path / "fog.yaml").write_text("provider: lokal\n")
    result = fog("ls", "--site", "fog.yaml")
    assert (result.exit_code, "fog.yaml:1:11: provider" in result.output) == (2, True)


def test_a_missing_launch_file_is_reported(fog: Run) -> None:
    result = fog("launch", "nowhere.py", "--dry-run")
    assert (result.exit_code, "nowhere.py" in result.output) == (2, True)


def test_the_final_log_lines_of_a_machine_that_is_gone_are_shown(fog: Run, journal: Journal) -> None:
    up(journal)
    gone = serving("m3").ended(Outcome.PREEMPTED, "killed", time.time())
    journal.put(gone, time.time(), "preempted", "killed", time.time() - 0.25)
    journal.write_event(time.time(), "c", "m3", FINAL_LOGS, "node", lines="one\nout of memory")
    said = fog("logs", "m3", "node", "-n", "1").output.splitlines()
    assert said == ["# m3 is gone: preempted, killed; its last lines:", "out of memory"]
    assert "kept are the last lines of node" in fog("logs", "m3", "switch").output
    assert "of node: out of memory" in fog("status", "--events").output
    assert "seen after 0.2" in fog("status", "--events").output
    assert "m3 is gone" in fog("ssh", "m3").output


def test_of_a_program_that_does_not_exist_the_programs_are_named(
    fog: Run, journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    up(journal)
    journal.put(serving("m1"), time.time(), "serving", "")
    provider = SimpleNamespace(poll_s=0.0, log=lambda *_: "", close=lambda: None)
    monkeypatch.setattr(logs, "open_provider", lambda site: provider)
    result = fog("logs", "m1", "nod")
    assert (result.exit_code, "no line of 'nod'; programs are node, proxy, switch" in result.output) == (2, True)
    assert fog("logs", "m1", "node").exit_code == 0


def test_events_in_a_pipe_end_without_blanks(fog: Run, journal: Journal) -> None:
    up(journal)
    journal.write_event(time.time(), "c", "m3", "trouble", "it is late")
    lines = fog("status", "--events").output.splitlines()
    assert any("it is late" in line for line in lines)
    assert all(line == line.rstrip() for line in lines)


def test_a_log_is_followed_until_its_machine_is_gone(
    fog: Run, journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    up(journal)
    windows = [["one", "two"], ["one", "two", "three"], ["three", "four"]]

    def log(machine: str, program: str, lines: int) -> str:
        window = windows.pop(0)
        if not windows:
            gone = serving("m1").ended(Outcome.RELEASED, "fog down", time.time())
            journal.put(gone, time.time(), "released", "fog down")
        return "\n".join(window)

    provider = SimpleNamespace(poll_s=0.0, log=log, close=lambda: None)
    monkeypatch.setattr(logs, "open_provider", lambda site: provider)
    monkeypatch.setattr(logs, "WATCH_S", 0.0)
    result = fog("logs", "m1", "node", "--follow", "-n", "1", "--json")
    said = [json.loads(line) for line in result.stdout.splitlines()]
    assert said == [{"machine": "m1", "program": "node", "line": each} for each in ("two", "three", "four")]
    assert "m1 is gone" in result.stderr


@pytest.mark.parametrize(
    ("known", "now", "new"),
    [
        ([], ["a"], ["a"]),
        (["a"], ["a"], []),
        (["a", "b"], ["b", "c"], ["c"]),
        (["a", "a"], ["a", "a", "a"], ["a"]),
        (["a", "b"], ["c", "d"], ["c", "d"]),
    ],
)
def test_of_a_log_only_what_is_new_is_shown(known: list[str], now: list[str], new: list[str]) -> None:
    assert logs.new_lines(known, now) == new


def test_states_and_events_are_followed_as_lines_of_json_in_a_pipe(
    fog: Run, journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    up(journal)

    def happen(seconds: float) -> None:
        if any(each.what == "draining" for each in journal.events("c")):
            raise KeyboardInterrupt
        journal.put(replace(serving("m1"), drained_unix_s=time.time()), time.time(), "draining", "asked")

    monkeypatch.setattr(status, "time", SimpleNamespace(time=time.time, sleep=happen))
    events = [json.loads(line) for line in fog("status", "--events", "--follow", "--json").stdout.splitlines()]
    assert events[-1]["what"] == "draining"


@pytest.mark.parametrize("is_salted", [True, False])
def test_a_new_sites_names_have_the_salt_of_its_owner_and_those_of_an_older_site_stay_plain(
    fog: Run, journal: Journal, monkeypatch: pytest.MonkeyPatch, *, is_salted: bool
) -> None:
    site = open_site(None)
    salt = load_salt(site.authority.owner)
    assert len(salt) >= 16
    if not is_salted:
        (site.authority.owner / OWNER_SALT).unlink()
    for each in ("set_up", "ensure"):
        monkeypatch.setattr(launch, each, lambda site: None)
    launch.begin(site, journal, PLAN)
    carried = journal.cluster(PLAN.name).plan.carried
    wanted = {"salt": salt} if is_salted else {}
    assert carried
    assert all(
        dict(metadata_of(each)) == {**metadata_of(own), **wanted}
        for each, own in zip(carried, PLAN.carried, strict=True)
    )


def test_a_regions_latency_is_shown(fog: Run, journal: Journal, tmp_path: Path) -> None:
    up(journal)
    site = open_site(None)
    (tmp_path / "fog.yaml").write_text(
        f"domain: {site.authority.domain}\nowner: {site.authority.owner}\nlatency_ms: {{east: 12, west: 80.5}}\n"
    )
    reported = json.loads(fog("status", "--json").output)
    assert [each["latency_ms"] for each in reported["members"]] == [12, 80.5]
    assert "80.5" in fog("status").output


@pytest.mark.parametrize(
    ("more", "how"), [((), "with the robot's nodes, or by fog down"), (("--detach",), "by fog down")]
)
def test_the_end_of_a_cluster_is_announced_before_it_begins(fog: Run, more: tuple[str, ...], how: str) -> None:
    said = fog("launch", str(ROOT / "examples" / "echo.launch.py"), "--dry-run", *more).output
    assert f"ends    {how}, after 30min" in said


def test_ros_launch_is_named_as_what_ends_its_cluster(fog: Run, tmp_path: Path) -> None:
    (tmp_path / "plan.json").write_text(PLAN.to_json())
    said = fog("launch", "plan.json", "--detach", "--dry-run", "--ends-with", "this launch").output
    assert "ends    with this launch, or by fog down" in said


def test_an_unknown_cluster_is_not_ended_in_silence(fog: Run, journal: Journal) -> None:
    up(journal)
    result = fog("down", "typo")
    assert (result.exit_code, result.output) == (2, f"error: no cluster is called typo; up: {PLAN.name}\n")
    assert fog("down", "typo", "--if-up").exit_code == 0


LAUNCH = """
from fog import *
def generate_launch_description():
    FogCluster(cloud_nodes=[Node(package="fog_demo", executable="echo")], deployments=[SpotMachine(%s)], services={}%s)
    return LaunchDescription()
"""


def launch_file(folder: Path, machine: str = "", more: str = "") -> str:
    (folder / "x.launch.py").write_text(LAUNCH % (machine, more), encoding="utf-8")
    return str(folder / "x.launch.py")


@pytest.mark.parametrize("options", [["--dry-run"], []])
def test_a_program_that_does_not_exist_is_refused_at_once(fog: Run, tmp_path: Path, options: list[str]) -> None:
    path = Path(launch_file(tmp_path))
    path.write_text(re.sub(r"executable=['\"][^'\"]*['\"]", "executable='absent_program'", path.read_text()))
    result = fog("launch", str(path), *options)
    assert (result.exit_code, "absent_program" in result.output) == (2, True)


@pytest.mark.parametrize("options", [["--dry-run"], []])
def test_a_misspelled_region_is_refused_at_once(fog: Run, tmp_path: Path, options: list[str]) -> None:
    result = fog("launch", launch_file(tmp_path), "--region", "us-wst-1", *options)
    assert (result.exit_code, "did you mean us-west-1?" in result.output) == (2, True)


def test_a_launch_says_what_it_does_before_its_cluster_is_wanted(
    fog: Run, journal: Journal, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for each in ("set_up", "ensure"):
        monkeypatch.setattr(launch, each, lambda site: None)
    launch.begin(open_site(None), journal, PLAN)
    assert capsys.readouterr().err.startswith("making keys, and starting ")


def test_a_launch_whose_cluster_is_given_back_ends_its_nodes_and_says_so(
    fog: Run, journal: Journal, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    sleep = RobotNode(CloudNode("p", "lib/client")), (sys.executable, "-c", "import time; time.sleep(60)")
    for each in ("set_up", "ensure", "end_cluster", "clear"):
        monkeypatch.setattr(launch, each, lambda *_, **__: None)
    monkeypatch.setattr(launch, "resolved", lambda node: sleep)

    def given_back(site: Site, journal: Journal, plan: ClusterPlan, *_: object, **__: object) -> None:
        journal.unwant(plan.name, "fog down", time.time())

    monkeypatch.setattr(launch, "follow", given_back)
    path = Path(launch_file(tmp_path))
    path.write_text(
        path.read_text().replace("LaunchDescription()", "LaunchDescription([Node(package='p', executable='e')])")
    )
    result = fog("launch", str(path))
    assert result.exit_code == 2
    assert re.search(r"^error: the cluster \S+ was given back: fog down$", result.output, re.MULTILINE)


def test_a_dry_run_makes_neither_a_site_nor_keys(fog: Run, tmp_path: Path) -> None:
    assert fog("launch", launch_file(tmp_path), "--dry-run").exit_code == 0
    assert not (tmp_path / "state").exists()


@pytest.mark.parametrize("options", [["--dry-run"], []])
def test_hardware_without_an_offer_is_refused_at_once_with_the_nearest(
    fog: Run, tmp_path: Path, options: list[str]
) -> None:
    result = fog("launch", launch_file(tmp_path, "hardware='cpu:999'"), *options)
    assert result.exit_code == 2
    assert "no spot machine with cpu:999; the nearest is" in result.output


def test_a_target_becomes_machines_and_says_what_it_assumes(fog: Run, tmp_path: Path) -> None:
    path = launch_file(tmp_path, more=", availability=0.9995")
    said = json.loads(fog("launch", path, "--dry-run", "--json").output)
    assert len(said["machines"]) == said["availability"]["replicas"] == 2
    assert any("15h on average" in line for line in said["availability"]["assumptions"])
    assert "target  0.9995 available; 2 replicas: none is up 0.04" in fog("launch", path, "--dry-run").output


def test_the_region_that_is_near_enough_is_worth_its_price(fog: Run, tmp_path: Path) -> None:
    fog("launch", launch_file(tmp_path), "--dry-run")
    keys = tmp_path / "keys"
    for name in ("domain", "owner"):
        (keys / name).mkdir(parents=True)
    with socket.create_server(("127.0.0.1", 0)) as near:
        stated = (
            "latency_ms: {local-a: 40, local-b: 40, local-c: 40}\nlatency: {endpoints: {local-d: '127.0.0.1:%d'}}\n"
        )
        (tmp_path / "fog.yaml").write_text(
            "domain: keys/domain\nowner: keys/owner\n" + stated % near.getsockname()[1], encoding="utf-8"
        )
        said = json.loads(fog("launch", launch_file(tmp_path), "--dry-run", "--json").output)
    assert said["machines"][0]["region"] == "local-d"
    assert said["latencies"]["local-d"]["source"].startswith("measured now, tcp://127.0.0.1:")
    assert said["latencies"]["local-a"] == {"ms": 40, "source": "latency_ms of fog.yaml"}


def test_tables_in_a_pipe_lose_nothing(fog: Run) -> None:
    shown = fog("prices", "--hardware", "T4", "--all").output
    assert "eu-central-1" in shown
    assert "…" not in shown


def test_the_width_of_tables_can_be_chosen_and_then_no_word_is_lost_either(fog: Run, journal: Journal) -> None:
    up(journal)
    narrow = fog("status", "--columns", "40").output
    assert max(map(len, narrow.splitlines()[:6])) <= 40
    assert "…" not in narrow
    assert max(map(len, fog("status").output.splitlines())) > 60


@pytest.mark.parametrize(("verb", "missing"), [("plan", "--target"), ("logs", "MACHINE"), ("launch", "FILE")])
def test_a_missing_argument_is_named(fog: Run, verb: str, missing: str) -> None:
    result = fog(verb)
    assert result.exit_code == 2
    assert missing in result.stderr


def test_an_unwatched_machine_is_running_and_not_serving() -> None:
    assert stage(serving("m1"), is_watched=False) == "running"
