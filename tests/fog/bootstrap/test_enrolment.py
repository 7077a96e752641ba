"""Joining of a machine of this host: its files and keys, its revocation, and the robot's rules."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fog.bootstrap.bundles import gateway_boot
from fog.bootstrap.members import Authority, metadata_of
from fog.bootstrap.robot_config import add_rules, reload_proxy, remove_rules
from fog.cluster import ExportedInterface
from fog.host.bundle import install
from fog.host.joining import join
from fog.site import open_site
from gdp.config.config import RibConfig, SwitchConfig
from gdp.config.drop_in import drop_in_directory
from gdp.crypto.certificates import Role
from gdp.crypto.statements import parse
from gdp.enrolment import domain_join, removal
from gdp.enrolment.removal import remove_machine
from gdp.errors import ConfigError, LocalError
from gdp.management.control_socket import ControlHandlers, serve_control_in_thread
from gdp.nodes.delegation_store import DelegationStore
from gdp.nodes.membership import load_member
from gdp.stores.keyring import load_identity, load_owner
from gdp.trust.enrolment_wire import UnreachableError
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from lab.process import until
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
    desk.join(tmp_path / "home")
    config = ProxyConfig.load(tmp_path / "home" / "proxy.yaml")
    switch = SwitchConfig.load(tmp_path / "home" / "switch.yaml")
    assert (switch.attach, [port.iface for port in switch.ports]) == (("proxy0",), ["eth0"])
    assert [(rule.name, rule.encoding) for rule in config.expose] == [("/plan", "cbor"), ("/map", "json")]


def test_a_machine_is_a_leaf_unless_it_may_become_the_gateway(desk: Desk, tmp_path: Path) -> None:
    for name, is_gateway, role in (("m1", False, Role.LEAF), ("m2", True, Role.SWITCH)):
        desk.join(tmp_path / name, name, is_gateway=is_gateway)
        config = SwitchConfig.load(tmp_path / name / "switch.yaml")
        assert load_member(config.identity, config.domain, Role.SWITCH)[0].role is role


def test_a_machine_may_give_what_is_carried_and_nothing_else(desk: Desk, tmp_path: Path) -> None:
    desk.join(tmp_path / "home")
    config = ProxyConfig.load(tmp_path / "home" / "proxy.yaml")
    held = DelegationStore(config.delegations, load_identity(config.identity, time.time()))
    key = load_owner(desk.authority.owner).key.public.compressed
    assert {(topic.name, topic.delegation.rights) for topic in held} == {
        (metadata_of(PLAN).name(key), frozenset({Right.SERVE})),
        (metadata_of(MAP).name(key), frozenset({Right.PUBLISH})),
    }


def test_machine_and_robot_derive_one_name_which_the_owners_key_alone_does_not_give(tmp_path: Path) -> None:
    with made_desk(tmp_path, CLUSTER.salted("unguessable")) as desk:
        desk.join(tmp_path / "home")
        path = desk.site.robots[0]
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
        desk.join(tmp_path / name, name)
    first, second = desk.members.find("c-m1"), desk.members.find("c-m2")
    assert first is not None
    assert second is not None
    assert first.name != second.name
    rows = [desk.registry.machine_with(f"c-{name}") for name in ("m1", "m2")]
    names = [{node.name for node in row.nodes} for row in rows if row is not None]
    assert [len(each) for each in names] == [2, 2]
    assert not names[0] & names[1]
    assert rows[0] is not None
    assert rows[0].until_unix_s == pytest.approx(time.time() + 86_400, abs=120)


def test_a_machine_that_has_joined_does_not_ask_again(desk: Desk, tmp_path: Path) -> None:
    desk.join(tmp_path / "home")
    assert not join(tmp_path / "home")
    assert load_identity(tmp_path / "home" / "member" / "switch", time.time()).label == "c-m7"


def test_a_machine_asks_until_its_launcher_is_there(desk: Desk, tmp_path: Path) -> None:
    install(tmp_path / "home", desk.boot())
    with ThreadPoolExecutor() as pool:
        asking = pool.submit(join, tmp_path / "home", deadline_s=30.0)
        key = tmp_path / "home" / "keys" / "proxy" / "node.csr"
        until(lambda: key.exists() or asking.done(), "keys")
        with desk.listening():
            assert asking.result()


def test_a_machine_gives_up_without_an_answer(desk: Desk, tmp_path: Path) -> None:
    install(tmp_path / "home", desk.boot())
    with pytest.raises(UnreachableError, match=r"the enrolment server is not reachable.*socket"):
        join(tmp_path / "home", deadline_s=0.1)


def test_a_machine_that_is_killed_while_it_joins_asks_with_the_same_keys(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path / "home", desk.boot())

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    with desk.listening():
        with monkeypatch.context() as patch:
            patch.setattr(domain_join, "_install", die)  # after the response
            with pytest.raises(KeyboardInterrupt):
                join(tmp_path / "home")
        assert join(tmp_path / "home")
    assert desk.members.misuses() == []
    assert not (tmp_path / "home" / "keys").exists()


def test_a_socket_below_a_long_path_is_reached(tmp_path: Path) -> None:
    folder = tmp_path / ("long" * 30)
    folder.mkdir()
    with made_desk(folder) as desk:
        desk.join(tmp_path / "home")


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


def test_what_is_gone_is_revoked_once_and_forgotten_when_it_would_have_run_out(desk: Desk, tmp_path: Path) -> None:
    folder, now_s = desk.files.config.revocations, time.time()
    for name in ("m1", "m2"):
        desk.join(tmp_path / name, name)
    gone = [load_identity(tmp_path / "m1" / "member" / each, now_s).member for each in ("switch", "proxy")]
    assert remove_machine(desk.files, "c-m1", unix_s=now_s).revoked == 2
    revoked = {Revocation.from_statement(parse(path.read_bytes())).fingerprint for path in folder.iterdir()}
    assert revoked == {each.fingerprint for each in gone}
    assert remove_machine(desk.files, "c-m1", unix_s=now_s).revoked == 0
    remove_machine(desk.files, "c-m2", unix_s=now_s + 2 * 86_400)  # all have run out
    assert not list(folder.iterdir())


def test_a_removal_that_was_interrupted_is_completed_by_the_next(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk.join(tmp_path / "m1", "m1")
    with monkeypatch.context() as patch:
        patch.setattr(removal, "write_all", lambda *_, **__: (_ for _ in ()).throw(LocalError("the disk is full")))
        with pytest.raises(LocalError):
            desk.members.remove("c-m1", unix_s=time.time())
    assert desk.members.remove("c-m1", unix_s=time.time())
    assert len(list(desk.files.config.revocations.iterdir())) == 2


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
