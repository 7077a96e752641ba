from __future__ import annotations

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest

from fog.cluster import Carried, CloudNode, ClusterPlan, Wanted
from fog.enrolment.boots import gateway_boot, machine_boot
from fog.enrolment.members import Authority, metadata_of
from fog.enrolment.revoking import take_back
from fog.enrolment.robot_side import forget_rules, introduce, processes_of
from fog.hardware import Hardware
from fog.host.bundle import install
from fog.site import open_site
from gdp.crypto.certificates import Role
from gdp.crypto.statements import parse
from gdp.errors import LocalError
from gdp.nodes.config import RibConfig, SwitchConfig
from gdp.nodes.membership import load_member
from gdp.stores.issue import make_domain, make_owner
from gdp.stores.keyring import load_identity, load_owner
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from proxy.config import ProxyConfig
from proxy.held import Held

PLAN = Carried("service", "/plan", "nav_msgs/srv/GetPlan", {"timeout_s": 9.0}, {"encoding": "cbor"})
MAP = Carried("topic", "/map", "nav_msgs/msg/OccupancyGrid")
CLUSTER = ClusterPlan("c", (CloudNode("p", "e", environment={"X": "1"}),), (Wanted(Hardware(cpus=1)),), (PLAN, MAP))


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    make_domain(tmp_path / "domain", "site")
    make_owner(tmp_path / "owner")
    return Authority(tmp_path / "domain", tmp_path / "owner")


def machine(authority: Authority, home: Path) -> ProxyConfig:
    boot, _ = machine_boot(
        authority, CLUSTER, "m7", lambda node: ("run", node.package), iface="eth0", days=1.0, shares_host=True
    )
    install(home, boot)
    return ProxyConfig.load(home / "proxy.yaml")


def test_a_machine_boots_with_files_that_the_nodes_take(authority: Authority, tmp_path: Path) -> None:
    config = machine(authority, tmp_path / "home")
    switch = SwitchConfig.load(tmp_path / "home" / "switch.yaml")
    assert (switch.attach, [port.iface for port in switch.ports]) == (("proxy0",), ["eth0"])
    assert [(rule.name, rule.encoding) for rule in config.expose] == [("/plan", "cbor"), ("/map", "json")]


@pytest.mark.parametrize(("uplink", "role"), [("", Role.LEAF), ("up", Role.SWITCH)])
def test_a_machine_is_a_leaf_unless_it_may_become_the_gateway(
    authority: Authority, tmp_path: Path, uplink: str, role: Role
) -> None:
    boot, _ = machine_boot(
        authority, CLUSTER, "m7", lambda _: ("run",), iface="eth0", days=1.0, shares_host=True, uplink=uplink
    )
    install(tmp_path / "home", boot)
    config = SwitchConfig.load(tmp_path / "home" / "switch.yaml")
    assert load_member(config.identity, config.domain, Role.SWITCH)[0].role is role


def test_a_machine_may_give_what_is_carried_and_nothing_else(authority: Authority, tmp_path: Path) -> None:
    config = machine(authority, tmp_path / "home")
    held = Held(config.delegations, load_identity(config.identity, time.time()))
    key = load_owner(authority.owner).key.public.compressed
    assert {(topic.name, topic.delegation.rights) for topic in held} == {
        (metadata_of(PLAN).name(key), frozenset({Right.SERVE})),
        (metadata_of(MAP).name(key), frozenset({Right.PUBLISH})),
    }


def test_no_two_machines_share_a_key(authority: Authority) -> None:
    papers = [
        machine_boot(authority, CLUSTER, name, lambda _: ("run",), iface="eth0", days=1.0, shares_host=False)[1]
        for name in ("m1", "m2")
    ]
    assert papers[0].proxy != papers[1].proxy
    assert not {*papers[0].fingerprints} & {*papers[1].fingerprints}
    assert papers[0].until_unix_s == pytest.approx(time.time() + 86_400, abs=120)


def test_nodes_start_first_and_know_their_machine(authority: Authority) -> None:
    boot, _ = machine_boot(authority, CLUSTER, "m7", lambda _: ("run",), iface="eth0", days=1.0, shares_host=True)
    assert [program.name for program in boot.programs] == ["node", "switch", "proxy"]
    assert boot.programs[0].environment["FOG_MACHINE"] == "m7"
    assert boot.programs[0].environment["X"] == "1"
    assert boot.programs[0].environment["FASTDDS_BUILTIN_TRANSPORTS"] == "UDPv4"


def test_a_gateway_is_a_switch_between_its_devices(authority: Authority, tmp_path: Path) -> None:
    install(tmp_path / "home", gateway_boot(authority, "edge", ["up", "machines"], days=1.0))
    switch = SwitchConfig.load(tmp_path / "home" / "switch.yaml")
    assert [port.iface for port in switch.ports] == ["up", "machines"]


def test_a_site_of_its_own_is_made_once_and_its_robot_can_start(tmp_path: Path) -> None:
    site = open_site(None, tmp_path / "state")
    assert open_site(None, tmp_path / "state") == site
    assert site.robot is not None
    assert ProxyConfig.load(site.robots[0]).imports == ()
    RibConfig.load(site.robot / "rib.yaml")
    assert SwitchConfig.load(site.robot / "switch.yaml").revocations == site.robot / "revocations"


OWN = "# mine\nimport:\n  # those\n  - {name: /own, type: std_msgs/msg/Empty, owner: ../owner/owner.pub}\n"


FLAT = OWN.replace("  ", "").replace("# those\n", "") + "spin_us: 0\n"


@pytest.mark.parametrize("own", ["", OWN, FLAT])
def test_the_robots_file_gets_a_line_a_name_and_is_as_before_when_they_are_taken_out(tmp_path: Path, own: str) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    with path.open("a") as file:
        file.write(own)
    first = path.read_text()
    introduce(path, site.authority, "c", CLUSTER.carried, days=1.0)
    config = ProxyConfig.load(path)
    assert {"/plan", "/map"} <= {rule.name for rule in config.imports}
    assert next(rule for rule in config.imports if rule.name == "/plan").timeout_s == 9.0
    held = Held(config.delegations, load_identity(config.identity, time.time()))
    assert sorted(right.value for topic in held for right in topic.delegation.rights) == ["call", "read"]
    assert forget_rules(path, "c")
    assert path.read_text() == first
    assert not forget_rules(path, "c")


def test_a_rule_that_the_robot_has_already_is_enough(tmp_path: Path) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    with path.open("a") as file:
        file.write('import:\n- {name: "/**", kind: service, owner: ../owner/owner.pub}\n')
    before = path.read_text()
    introduce(path, site.authority, "c", [PLAN], days=1.0)
    assert path.read_text() == before


def test_a_list_in_one_line_is_refused_and_left_alone(tmp_path: Path) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    with path.open("a") as file:
        file.write("import: []\n")
    before = path.read_text()
    with pytest.raises(LocalError, match="a line for each rule"):
        introduce(path, site.authority, "c", [PLAN], days=1.0)
    assert path.read_text() == before


def test_what_is_gone_is_revoked_once_and_forgotten_when_it_would_have_run_out(
    authority: Authority, tmp_path: Path
) -> None:
    folder, now_s = tmp_path / "revocations", time.time()
    folder.mkdir()
    first, second = "ab" * 32, "cd" * 32
    assert take_back(authority.domain, folder, [first], until_unix_s=now_s + 60, unix_s=now_s)
    assert not take_back(authority.domain, folder, [first], until_unix_s=now_s + 60, unix_s=now_s)
    (path,) = folder.iterdir()
    assert Revocation.from_statement(parse(path.read_bytes())).fingerprint == bytes.fromhex(first)
    assert take_back(authority.domain, folder, [second], until_unix_s=now_s + 90_000, unix_s=now_s + 80_000)
    assert [path.name for path in folder.iterdir()] == [f"{second[:32]}.revoke"]


def test_only_proxies_that_run_with_the_file_and_take_the_signal_are_told(tmp_path: Path) -> None:
    path = tmp_path / "proxy.yaml"
    path.touch()
    takes, says = "import signal; signal.signal(signal.SIGHUP, print); ", "print(1, flush=True); signal.pause()"
    programs = [
        (f"{takes}{says}", "gdp-proxy", path),
        (f"{takes}{says}", "gdp-proxy", tmp_path / "other.yaml"),
        (f"{takes}{says}", "editor", path),
        (f"import signal; {says}", "gdp-proxy", path),  # it only checks, or is still starting
    ]
    with ExitStack() as stack:
        running = []
        for code, name, file in programs:
            argv = [sys.executable, "-c", code, name, "--config", str(file)]
            program = stack.enter_context(subprocess.Popen(argv, stdout=subprocess.PIPE))
            stack.callback(program.kill)
            assert program.stdout is not None
            assert program.stdout.readline()
            running.append(program.pid)
        assert list(processes_of(path)) == running[:1]


def test_two_launches_change_the_robots_file_one_after_the_other(tmp_path: Path) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    names = [f"c{number}" for number in range(4)]
    with ThreadPoolExecutor() as pool:
        for number, name in enumerate(names):
            service = Carried("service", f"/plan{number}", "nav_msgs/srv/GetPlan")
            pool.submit(introduce, path, site.authority, name, [service], days=1.0)
    assert {rule.name for rule in ProxyConfig.load(path).imports} == {f"/plan{number}" for number in range(4)}
    with ThreadPoolExecutor() as pool:
        assert all(pool.map(lambda name: forget_rules(path, name), names))
    assert not ProxyConfig.load(path).imports
