"""QoS of shared topics: it comes with the offer, follows the publishers, and only who offered a name may state it."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.config.offered_qos import OFFERED_DEPTH_MAX, OfferedQos
from gdp.errors import StatementError
from gdp.names import Name
from gdp.sharing.exchange import MailKind
from gdp.stores.keyring import CARD, load_card
from proxy.config.config import ProxyConfig
from tests.gdp.sharing.machines import DAY_S, STRING, Machine, Site, importing

LATCHED = OfferedQos(reliability="reliable", durability="transient_local", depth=1)
CLOCK = OfferedQos(reliability="best_effort", durability="volatile", depth=10)
TOPIC = "/robot_description"
NAME = Name(bytes(range(32)))


@pytest.fixture
def robot(site: Site) -> Machine:
    robot = site.machines["robot"]
    robot.graph, robot.qos = [("topic", TOPIC, STRING)], {TOPIC: LATCHED}
    return robot


def offered(machine: Machine) -> list[OfferedQos | None]:
    return [rule.offered for rule in ProxyConfig.load(machine.path).imports]


@pytest.mark.parametrize("type_name", ["", STRING], ids=["type as found", "type stated"])
def test_the_publishers_qos_comes_with_the_offer(site: Site, robot: Machine, server: Machine, type_name: str) -> None:
    robot.sharing.expose(robot.exposing(TOPIC, "server", type_name=type_name), site.now_s)
    report = server.sharing.accept(importing(TOPIC), site.now_s)
    assert (offered(server), report.problems) == ([LATCHED], [])


def test_another_qos_reaches_the_importing_rule_with_the_next_upkeep_and_the_name_stays(
    site: Site, robot: Machine, server: Machine
) -> None:
    robot.sharing.expose(robot.exposing(TOPIC, "server"), site.now_s)
    server.sharing.accept(importing(TOPIC), site.now_s)
    names = [each.name for each in server.held]
    robot.qos[TOPIC] = CLOCK
    assert site.upkeep() == []
    assert (offered(server), [each.name for each in server.held]) == ([CLOCK], names)


def test_an_unchanged_qos_is_sent_once_and_survives_the_renewal_of_the_delegation(
    site: Site, robot: Machine, server: Machine
) -> None:
    robot.sharing.expose(robot.exposing(TOPIC, "server", days=3), site.now_s)
    server.sharing.accept(importing(TOPIC), site.now_s)
    assert site.upkeep() == []
    robot.sharing.work(site.now_s)
    assert not site.directory.mail[load_card(server.folder / "proxy" / CARD).name]
    site.now_s += 2.5 * DAY_S
    assert site.upkeep() == []
    assert offered(server) == [LATCHED]


def test_a_publisher_that_comes_later_states_its_qos_then(site: Site, robot: Machine, server: Machine) -> None:
    robot.qos = {}
    robot.sharing.expose(robot.exposing(TOPIC, "server", type_name=STRING), site.now_s)
    server.sharing.accept(importing(TOPIC), site.now_s)
    assert offered(server) == [None]
    robot.qos = {TOPIC: LATCHED}
    assert site.upkeep() == []
    assert offered(server) == [LATCHED]


def test_a_topic_that_is_shared_by_a_rule_of_a_file_states_its_qos_too(
    site: Site, server: Machine, tmp_path: Path
) -> None:
    with ExitStack() as stack:
        rule = f"expose:\n- {{name: {TOPIC}, type: {STRING}, owner: owner.pub}}\n"
        rules = site.add("third", rule, is_salted=False)
        rules.start(stack)
        rules.graph, rules.qos = [("topic", TOPIC, STRING)], {TOPIC: LATCHED}
        rules.sharing.share(rules.owner, TOPIC, ["server"], site.now_s, days=30)
        server.sharing.accept(importing(TOPIC), site.now_s)
        assert site.upkeep() == []
        site.upkeep()
    assert offered(server) == [LATCHED]


def test_only_the_sender_of_an_offer_states_its_qos(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing(TOPIC, "server"), site.now_s)
    server.sharing.accept(importing(TOPIC), site.now_s)
    name, to = server.held[0].name, load_card(server.folder / "proxy" / CARD).name
    site.directory.of("stranger").send(to, MailKind.QOS.value, CLOCK.to_wire(name))
    (problem,) = server.sharing.work(site.now_s).problems
    assert problem.startswith("mail from stranger is not taken: news of ")
    assert offered(server) == [LATCHED]


@given(
    st.binary(max_size=64)
    | st.builds(CLOCK.to_wire, st.binary(min_size=32, max_size=32).map(Name)).map(lambda w: w[:-1])
)
def test_a_mail_that_is_not_of_the_form_is_refused(wire: bytes) -> None:
    with pytest.raises(StatementError):
        OfferedQos.from_wire(wire)


@given(
    st.sampled_from(["reliable", "best_effort"]),
    st.sampled_from(["volatile", "transient_local"]),
    st.integers(1, OFFERED_DEPTH_MAX),
)
def test_what_is_sent_arrives(reliability: str, durability: str, depth: int) -> None:
    qos = OfferedQos.from_fields({"reliability": reliability, "durability": durability, "depth": depth})
    assert OfferedQos.from_wire(qos.to_wire(NAME)) == (NAME, qos)
