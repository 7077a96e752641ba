"""Enrolment of a machine: its files and keys, the listener, and the robot's rules."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fog.bootstrap.bundles import gateway_boot
from fog.bootstrap.listener import bind_tcp
from fog.bootstrap.members import Authority, metadata_of, revoke_credentials
from fog.bootstrap.robot_config import add_rules, reload_proxy, remove_rules
from fog.cluster import ExportedInterface
from fog.host.bundle import install
from fog.host.enrolment import enrol
from fog.site import open_site
from gdp.config.config import RibConfig, SwitchConfig
from gdp.config.drop_in import drop_in_directory
from gdp.crypto.certificates import Role
from gdp.crypto.statements import parse
from gdp.errors import ConfigError, LocalError
from gdp.management.control_socket import ControlHandlers, serve_control_in_thread
from gdp.nodes.delegation_store import DelegationStore
from gdp.nodes.membership import load_member
from gdp.stores.keyring import load_identity, load_owner
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from proxy.config.config import ProxyConfig
from tests.fog.bootstrap.desk import CLUSTER, MAP, PLAN, Desk, made_desk


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    with made_desk(tmp_path) as made:
        yield made


@pytest.fixture
def authority(desk: Desk) -> Authority:
    return desk.authority


def test_a_machine_boots_with_files_that_the_nodes_take(desk: Desk, tmp_path: Path) -> None:
    desk.enrol(tmp_path / "home")
    config = ProxyConfig.load(tmp_path / "home" / "proxy.yaml")
    switch = SwitchConfig.load(tmp_path / "home" / "switch.yaml")
    assert (switch.attach, [port.iface for port in switch.ports]) == (("proxy0",), ["eth0"])
    assert [(rule.name, rule.encoding) for rule in config.expose] == [("/plan", "cbor"), ("/map", "json")]


def test_a_machine_is_a_leaf_unless_it_may_become_the_gateway(desk: Desk, tmp_path: Path) -> None:
    for name, is_gateway, role in (("m1", False, Role.LEAF), ("m2", True, Role.SWITCH)):
        desk.enrol(tmp_path / name, name, is_gateway=is_gateway)
        config = SwitchConfig.load(tmp_path / name / "switch.yaml")
        assert load_member(config.identity, config.domain, Role.SWITCH)[0].role is role


def test_a_machine_may_give_what_is_carried_and_nothing_else(desk: Desk, tmp_path: Path) -> None:
    desk.enrol(tmp_path / "home")
    config = ProxyConfig.load(tmp_path / "home" / "proxy.yaml")
    held = DelegationStore(config.delegations, load_identity(config.identity, time.time()))
    key = load_owner(desk.authority.owner).key.public.compressed
    assert {(topic.name, topic.delegation.rights) for topic in held} == {
        (metadata_of(PLAN).name(key), frozenset({Right.SERVE})),
        (metadata_of(MAP).name(key), frozenset({Right.PUBLISH})),
    }


def test_machine_and_robot_derive_one_name_which_the_owners_key_alone_does_not_give(tmp_path: Path) -> None:
    with made_desk(tmp_path, CLUSTER.salted("unguessable")) as desk:
        desk.enrol(tmp_path / "home")
        path = open_site(None, tmp_path / "state").robots[0]
        add_rules(path, desk.authority, "c", desk.cluster.carried, days=1.0)
    served, used = ProxyConfig.load(tmp_path / "home" / "proxy.yaml").expose, ProxyConfig.load(path).imports
    names = {rule.overlay_name_of(rule.name, rule.type_name) for rule in served}
    assert names == {rule.overlay_name_of(rule.name, rule.type_name) for rule in used}
    key = load_owner(desk.authority.owner).key.public.compressed
    assert names == {metadata_of(each).name(key) for each in desk.cluster.carried}
    assert not names & {metadata_of(each).name(key) for each in (PLAN, MAP)}
    assert {each.stat().st_mode & 0o777 for each in drop_in_directory(path).iterdir()} == {0o600}


def test_no_two_machines_share_a_key(desk: Desk, tmp_path: Path) -> None:
    for name in ("m1", "m2"):
        desk.enrol(tmp_path / name, name)
    issued_credentials = [each.issued_credentials for each in desk.tickets.pending_reports()]
    assert issued_credentials[0] is not None
    assert issued_credentials[1] is not None
    assert issued_credentials[0].proxy != issued_credentials[1].proxy
    assert not {*issued_credentials[0].fingerprints} & {*issued_credentials[1].fingerprints}
    assert issued_credentials[0].until_unix_s == pytest.approx(time.time() + 86_400, abs=120)


def test_a_machine_that_has_enrolled_does_not_ask_again(desk: Desk, tmp_path: Path) -> None:
    desk.enrol(tmp_path / "home")
    assert not enrol(tmp_path / "home")
    assert load_identity(tmp_path / "home" / "switch", time.time()).label == "c-m7"


def test_a_machine_asks_until_its_launcher_is_there(desk: Desk, tmp_path: Path) -> None:
    install(tmp_path / "home", desk.boot())
    with ThreadPoolExecutor() as pool:
        asking = pool.submit(enrol, tmp_path / "home", patience_s=30.0)
        key = tmp_path / "home" / "proxy" / "node.csr"
        while not key.exists() and not asking.done():
            time.sleep(0.01)
        with desk.listening():
            assert asking.result()


def test_a_machine_gives_up_without_an_answer(desk: Desk, tmp_path: Path) -> None:
    install(tmp_path / "home", desk.boot())
    with pytest.raises(LocalError, match=r"this machine was not enrolled.*socket"):
        enrol(tmp_path / "home", patience_s=0.1)


def test_a_machine_enrols_over_tcp(desk: Desk, tmp_path: Path) -> None:
    bound = bind_tcp("127.0.0.1", 0)
    ticket = desk.ticket(address=f"tcp://127.0.0.1:{bound.getsockname()[1]}")
    install(tmp_path / "home", desk.boot(ticket=ticket))
    with desk.listening(bound):
        assert enrol(tmp_path / "home")


def test_a_socket_below_a_long_path_is_reached(tmp_path: Path) -> None:
    folder = tmp_path / ("long" * 40)
    folder.mkdir()
    with made_desk(folder) as desk:
        desk.enrol(tmp_path / "home")


def test_nodes_start_first_and_know_their_machine(desk: Desk) -> None:
    boot = desk.boot()
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


@pytest.mark.parametrize("own", ["", OWN, "import: []\n"])
def test_the_robot_gets_a_rule_a_name_and_none_is_left_when_the_cluster_is_gone(tmp_path: Path, own: str) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    with path.open("a") as file:
        file.write(own)
    first = path.read_text()
    add_rules(path, site.authority, "c", CLUSTER.carried, days=1.0)
    config = ProxyConfig.load(path)
    assert {"/plan", "/map"} <= {rule.name for rule in config.imports}
    assert next(rule for rule in config.imports if rule.name == "/plan").timeout_s == 9.0
    held = DelegationStore(config.delegations, load_identity(config.identity, time.time()))
    assert sorted(right.value for topic in held for right in topic.delegation.rights) == ["call", "read"]
    assert path.read_text() == first
    assert remove_rules(path, "c")
    assert {rule.name for rule in ProxyConfig.load(path).imports} == ({"/own"} if own == OWN else set())
    assert not remove_rules(path, "c")


def test_a_rule_that_the_robot_has_already_is_enough(tmp_path: Path) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    with path.open("a") as file:
        file.write('import:\n- {name: "/**", kind: service, owner: ../owner/owner.pub}\n')
    add_rules(path, site.authority, "c", [PLAN], days=1.0)
    assert not drop_in_directory(path).exists()


def test_further_names_of_a_cluster_are_added_to_its_file(tmp_path: Path) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    add_rules(path, site.authority, "c", [PLAN], days=1.0)
    add_rules(path, site.authority, "c", [PLAN, MAP], days=1.0)
    assert [rule.name for rule in ProxyConfig.load(path).imports] == [PLAN.name, MAP.name]
    assert [file.name for file in drop_in_directory(path).iterdir()] == ["fog-c.yaml"]


def test_a_rule_that_conflicts_with_the_robots_is_refused_and_leaves_no_file(tmp_path: Path) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    with path.open("a") as file:
        file.write(
            f"expose:\n- {{name: {PLAN.name}, kind: service, type: {PLAN.type_name}, owner: ../owner/owner.pub}}\n"
        )
    with pytest.raises(ConfigError, match=r"proxy\.yaml\.d/fog-c\.yaml:3:.*import\[0\]"):
        add_rules(path, site.authority, "c", [PLAN], days=1.0)
    assert not list(drop_in_directory(path).iterdir())


def test_what_is_gone_is_revoked_once_and_forgotten_when_it_would_have_run_out(
    authority: Authority, tmp_path: Path
) -> None:
    folder, now_s = tmp_path / "revocations", time.time()
    folder.mkdir()
    first, second = "ab" * 32, "cd" * 32
    assert revoke_credentials(authority.domain, folder, [first], until_unix_s=now_s + 60, unix_s=now_s)
    assert not revoke_credentials(authority.domain, folder, [first], until_unix_s=now_s + 60, unix_s=now_s)
    (path,) = folder.iterdir()
    assert Revocation.from_statement(parse(path.read_bytes())).fingerprint == bytes.fromhex(first)
    assert revoke_credentials(authority.domain, folder, [second], until_unix_s=now_s + 90_000, unix_s=now_s + 80_000)
    assert [path.name for path in folder.iterdir()] == [f"{second[:32]}.revoke"]


class Proxy:
    """Control handlers of a proxy that counts reloads."""

    def __init__(self, refusal: str = "") -> None:
        self.reloads = 0
        self.refusal = refusal

    def handlers(self) -> ControlHandlers:
        return ControlHandlers(reload=self._reload, status=dict, drain=lambda: None)

    def _reload(self) -> None:
        self.reloads += 1
        if self.refusal:
            raise LocalError(self.refusal)


def test_a_running_proxy_reloads_by_its_control_socket(tmp_path: Path) -> None:
    path = open_site(None, tmp_path / "state").robots[0]
    path.write_text(f"{path.read_text()}control_socket: {tmp_path}/proxy.sock\n")
    proxy = Proxy()
    assert not reload_proxy(path)
    with serve_control_in_thread(tmp_path / "proxy.sock", proxy.handlers()):
        assert reload_proxy(path)
    assert proxy.reloads == 1


def test_a_proxy_that_refuses_its_new_configuration_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = open_site(None, tmp_path / "state").robots[0]
    path.write_text(f"{path.read_text()}control_socket: {tmp_path}/proxy.sock\n")
    with serve_control_in_thread(tmp_path / "proxy.sock", Proxy("iface changed").handlers()):
        assert not reload_proxy(path)
    assert "iface changed" in caplog.text


def test_two_launches_change_the_robots_file_one_after_the_other(tmp_path: Path) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    names = [f"c{number}" for number in range(4)]
    with ThreadPoolExecutor() as pool:
        for number, name in enumerate(names):
            service = ExportedInterface("service", f"/plan{number}", "nav_msgs/srv/GetPlan")
            pool.submit(add_rules, path, site.authority, name, [service], days=1.0)
    assert {rule.name for rule in ProxyConfig.load(path).imports} == {f"/plan{number}" for number in range(4)}
    with ThreadPoolExecutor() as pool:
        assert all(pool.map(lambda name: remove_rules(path, name), names))
    assert not ProxyConfig.load(path).imports
