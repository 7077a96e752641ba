"""Names that a machine no longer exposes: who imports them learns it, and learns when they come back."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import StatementError
from gdp.names import Name
from gdp.sharing.exchange import Exposure, MailKind
from gdp.stores.keyring import CARD, load_card
from tests.gdp.sharing.machines import DAY_S, PLAN, STRING, Machine, Site, importing

TOPIC = "/robot_description"
WITHDRAWN = "withdrawn: robot no longer exposes it"


def states(machine: Machine) -> list[str]:
    return [state for _, state in machine.sharing.offers()]


def waiting(site: Site, machine: Machine) -> list[str]:
    return [mail.kind for mail in site.directory.mail[load_card(machine.folder / "proxy" / CARD).name]]


@pytest.mark.parametrize(("kind", "name", "type_name"), [("topic", TOPIC, STRING), ("service", "/plan", PLAN)])
def test_an_imported_name_is_withdrawn_while_the_other_machine_does_not_expose_it(
    site: Site, robot: Machine, server: Machine, kind: str, name: str, type_name: str
) -> None:
    robot.sharing.expose(robot.exposing(name, "server", kind=kind, type_name=type_name), site.now_s)
    server.sharing.accept(importing(name), site.now_s)
    assert (states(server), server.rules("import"), list(server.rights())) == (["used"], [(name, type_name)], [name])
    assert robot.sharing.stop_exposing(kind, name, site.now_s).problems == []
    assert site.upkeep() == []
    assert (states(server), server.rules("import"), server.held) == ([WITHDRAWN], [], [])
    robot.sharing.expose(robot.exposing(name, "server", kind=kind, type_name=type_name), site.now_s)
    assert site.upkeep() == []
    assert (states(server), server.rules("import"), list(server.rights())) == (["used"], [(name, type_name)], [name])


def test_an_offer_that_is_not_accepted_is_withdrawn_too(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing(TOPIC, "server", type_name=STRING), site.now_s)
    site.upkeep()
    assert states(server) == ["offered"]
    robot.sharing.stop_exposing("topic", TOPIC, site.now_s)
    site.upkeep()
    assert states(server) == [WITHDRAWN]


def _drop_rule(robot: Machine) -> None:
    head, _, _ = robot.path.read_text().partition("expose:")
    robot.path.write_text(head)


def _drop_drop_in(robot: Machine) -> None:
    (robot.folder / "proxy.yaml.d" / "gdp-rule.yaml").unlink()


RULE = f"expose:\n- {{name: {TOPIC}, type: {STRING}, owner: owner.pub}}\n"
DROP_IN = RULE.replace("owner.pub", "../owner.pub")


@pytest.mark.parametrize(
    ("rules", "drop_in", "remove"), [(RULE, "", _drop_rule), ("", DROP_IN, _drop_drop_in)], ids=["file", "drop-in"]
)
def test_a_rule_that_a_person_removes_counts_as_well(
    site: Site, server: Machine, rules: str, drop_in: str, remove: Callable[[Machine], None]
) -> None:
    third = site.add("third", rules, is_salted=False)
    if drop_in:
        (third.folder / "proxy.yaml.d").mkdir()
        (third.folder / "proxy.yaml.d" / "gdp-rule.yaml").write_text(drop_in)
    third.sharing.share(third.owner, TOPIC, ["server"], site.now_s, days=30)
    server.sharing.accept(importing(TOPIC), site.now_s)
    site.upkeep()
    assert states(server) == ["used"]
    remove(third)
    third.sharing.work(site.now_s)
    site.upkeep()
    assert states(server) == ["withdrawn: third no longer exposes it"]


def test_a_name_that_another_rule_or_another_machine_gives_is_not_withdrawn(
    site: Site, robot: Machine, server: Machine
) -> None:
    with ExitStack() as stack:
        site.add("laptop").start(stack)
        robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=STRING), site.now_s)
        robot.sharing.expose(robot.exposing("/camera/**", "server"), site.now_s)
        robot.sharing.expose(robot.exposing(TOPIC, "server", type_name=STRING), site.now_s)
        robot.sharing.share(robot.owner, TOPIC, ["laptop"], site.now_s, type_name=STRING, is_giving=True, days=30)
        for name in ("/camera/image", TOPIC):
            server.sharing.accept(importing(name), site.now_s)
            robot.sharing.stop_exposing("topic", name, site.now_s)
        site.upkeep()
        assert states(server) == ["used", "used"]


def test_a_name_that_is_shared_and_never_exposed_here_is_not_withdrawn(
    site: Site, robot: Machine, server: Machine
) -> None:
    robot.sharing.share(robot.owner, TOPIC, ["server"], site.now_s, type_name=STRING, days=30)
    server.sharing.accept(importing(TOPIC), site.now_s)
    for _ in range(2):
        site.upkeep()
    assert states(server) == ["used"]


def test_the_mail_is_sent_once_and_later_where_the_exchange_does_not_answer(
    site: Site, robot: Machine, server: Machine
) -> None:
    robot.sharing.expose(robot.exposing(TOPIC, "server", type_name=STRING), site.now_s)
    site.upkeep()
    site.directory.is_down = True
    report = robot.sharing.stop_exposing("topic", TOPIC, site.now_s)
    assert (report.is_running, report.problems) == (True, ["the domain's server does not answer"])
    site.directory.is_down = False
    for _ in range(2):
        robot.sharing.work(site.now_s)
    assert waiting(site, server) == [MailKind.EXPOSURE.value]


def test_a_renewal_of_the_delegation_leaves_a_name_withdrawn(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing(TOPIC, "server", type_name=STRING, days=3), site.now_s)
    server.sharing.accept(importing(TOPIC), site.now_s)
    robot.sharing.stop_exposing("topic", TOPIC, site.now_s)
    site.now_s += 2.5 * DAY_S
    assert site.upkeep() == []
    assert (states(server), waiting(site, server)) == ([WITHDRAWN], [])
    robot.sharing.expose(robot.exposing(TOPIC, "server", type_name=STRING), site.now_s)
    assert site.upkeep() == []
    assert states(server) == ["used"]


def test_another_owners_equal_name_takes_the_place_of_a_withdrawn_one(
    site: Site, robot: Machine, server: Machine
) -> None:
    with ExitStack() as stack:
        other = site.add("other")
        other.start(stack)
        for each in (robot, other):
            each.sharing.expose(each.exposing(TOPIC, "server", type_name=STRING), site.now_s)
        server.sharing.accept(importing(TOPIC), site.now_s)
        robot.sharing.stop_exposing("topic", TOPIC, site.now_s)
        site.upkeep()
        assert states(server) == [WITHDRAWN, "used"]


def test_only_the_sender_of_an_offer_withdraws_it(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing(TOPIC, "server", type_name=STRING), site.now_s)
    server.sharing.accept(importing(TOPIC), site.now_s)
    wire = Exposure(server.held[0].name, False).to_cbor()
    site.directory.of("stranger").send(load_card(server.folder / "proxy" / CARD).name, MailKind.EXPOSURE.value, wire)
    (problem,) = server.sharing.work(site.now_s).problems
    assert problem.startswith("mail from stranger is not taken: news of ")
    assert states(server) == ["used"]


@given(st.binary(max_size=64))
def test_a_mail_that_is_not_of_the_form_is_refused(wire: bytes) -> None:
    with pytest.raises(StatementError):
        Exposure.from_cbor(wire)


@given(st.binary(min_size=32, max_size=32).filter(any).map(Name), st.booleans())
def test_what_is_sent_arrives(name: Name, is_exposed: bool) -> None:
    stated = Exposure(name, is_exposed)
    assert Exposure.from_cbor(stated.to_cbor()) == stated
