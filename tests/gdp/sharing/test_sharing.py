"""Names that machines share: rules of live proxies, delegations, offers, revocation and renewal, in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from gdp.client.send_options import SendOptions
from gdp.crypto.statements import parse
from gdp.errors import LocalError
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.sharing.exchange import Mail, MailKind
from gdp.sharing.issued import IssuedStore
from gdp.sharing.state import AcceptedName, links_of
from gdp.stores.keyring import OWNER_SALT, load_owner
from gdp.trust.revocation import Revocation
from proxy.config.config import ProxyConfig
from tests.gdp.sharing.machines import DAY_S, IMAGE, PLAN, STRING, Machine, Site, importing


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def robot(site: Site, stack: ExitStack) -> Machine:
    robot = site.add("robot")
    robot.start(stack)
    return robot


@pytest.fixture
def server(site: Site, stack: ExitStack) -> Machine:
    server = site.add("server")
    server.start(stack)
    return server


def kept_in(spread: list[bytes]) -> Callable[[Sequence[bytes]], bool]:
    """Return a switch that takes revocations."""

    def take(statements: Sequence[bytes]) -> bool:
        spread.extend(statements)
        return True

    return take


def test_a_topic_that_is_exposed_and_imported_has_its_rules_and_rights_on_both_machines(
    site: Site, robot: Machine, server: Machine
) -> None:
    before = robot.path.read_bytes()
    report = robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    assert (report.is_running, report.problems) == (True, [])
    assert server.sharing.accept(importing("/camera/image"), site.now_s).is_running
    assert robot.rules("expose") == server.rules("import") == [("/camera/image", IMAGE)]
    assert (robot.rights(), server.rights()) == ({"/camera/image": {"publish"}}, {"/camera/image": {"read"}})
    assert robot.path.read_bytes() == before


def name_of(machine: Machine, side: str) -> Name:
    config = ProxyConfig.load(machine.path)
    (rule,) = config.expose if side == "expose" else config.imports
    name = rule.overlay_name_of("/camera/image", IMAGE)
    assert name is not None
    return name


def plain_name(robot: Machine) -> Name:
    metadata = Metadata({"kind": "topic", "name": "/camera/image", "type": IMAGE})
    return metadata.name(load_owner(robot.owner).public.compressed)


@pytest.mark.parametrize("asked", ["/camera/image", "/camera/**"])
def test_both_machines_derive_the_same_name_which_the_owners_key_alone_does_not_give(
    site: Site, robot: Machine, server: Machine, asked: str
) -> None:
    robot.graph = [("topic", "/camera/image", IMAGE)]
    robot.sharing.expose(robot.exposing(asked, "server"), site.now_s)
    site.upkeep()
    server.sharing.accept(importing(asked), site.now_s)
    assert name_of(robot, "expose") == name_of(server, "import") == robot.held[0].name == server.held[0].name
    assert name_of(robot, "expose") != plain_name(robot)
    for machine in (robot, server):
        drop_in = machine.folder / "proxy.yaml.d" / "gdp-share.yaml"
        assert drop_in.stat().st_mode & 0o777 == 0o600


def test_a_name_without_a_salt_is_asked_for_by_an_option(site: Site, robot: Machine, server: Machine) -> None:
    wanted = robot.exposing("/camera/image", "server", type_name=IMAGE)
    robot.sharing.expose(wanted, site.now_s, is_plain=True)
    server.sharing.accept(importing("/camera/image"), site.now_s)
    assert name_of(robot, "expose") == name_of(server, "import") == plain_name(robot)


def test_an_owner_without_a_salt_keeps_plain_names(site: Site, server: Machine, stack: ExitStack) -> None:
    robot = site.add("robot", is_salted=False)
    robot.start(stack)
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    server.sharing.accept(importing("/camera/image"), site.now_s)
    assert name_of(robot, "expose") == name_of(server, "import") == plain_name(robot)


@pytest.mark.parametrize("is_plain", [False, True])
def test_a_name_never_changes_though_its_rule_is_removed_and_the_owners_salt_changes(
    site: Site, robot: Machine, server: Machine, *, is_plain: bool
) -> None:
    wanted = robot.exposing("/camera/image", "server", type_name=IMAGE)
    robot.sharing.expose(wanted, site.now_s, is_plain=is_plain)
    before = name_of(robot, "expose")
    robot.sharing.stop_exposing("topic", "/camera/image", site.now_s)
    (robot.owner / OWNER_SALT).write_text("another")
    robot.sharing.expose(wanted, site.now_s)
    assert name_of(robot, "expose") == before


def test_a_name_with_a_salt_does_not_become_plain(site: Site, robot: Machine, server: Machine) -> None:
    wanted = robot.exposing("/camera/image", "server", type_name=IMAGE)
    robot.sharing.expose(wanted, site.now_s)
    robot.sharing.stop_exposing("topic", "/camera/image", site.now_s)
    with pytest.raises(LocalError, match="has a salt already, and a name never changes"):
        robot.sharing.expose(wanted, site.now_s, is_plain=True)


def test_a_name_that_is_shared_and_not_exposed_has_the_owners_salt(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.share(robot.owner, "/camera/image", ["server"], site.now_s, type_name=IMAGE, is_giving=True, days=30)
    server.sharing.accept(AcceptedName(side="expose", name="/camera/image"), site.now_s)
    assert name_of(server, "expose") == server.held[0].name != plain_name(robot)


def test_a_shared_name_of_a_rule_with_metadata_is_imported_with_them(
    site: Site, server: Machine, stack: ExitStack
) -> None:
    rule = f"expose: [{{name: /camera/image, type: {IMAGE}, owner: owner.pub, metadata: {{lens: wide}}}}]\n"
    robot = site.add("robot", rule)
    robot.start(stack)
    robot.sharing.share(robot.owner, "/camera/image", ["server"], site.now_s, days=30)
    server.sharing.accept(importing("/camera/image"), site.now_s)
    assert name_of(robot, "expose") == name_of(server, "import") == server.held[0].name


def test_a_service_is_served_here_and_called_there(site: Site, robot: Machine, server: Machine) -> None:
    server.sharing.expose(server.exposing("/plan", "robot", type_name=PLAN, kind="service"), site.now_s)
    robot.sharing.accept(importing("/plan"), site.now_s)
    assert (server.rights(), robot.rights()) == ({"/plan": {"serve"}}, {"/plan": {"call"}})


def test_topics_of_a_pattern_are_delegated_as_they_appear(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing("/camera/**", "server"), site.now_s)
    server.sharing.accept(importing("/camera/**"), site.now_s)
    assert (robot.rules("expose"), server.rules("import")) == ([("/camera/**", "")], [])
    robot.graph += [("topic", "/camera/left/image", IMAGE), ("topic", "/joint_states", STRING)]
    assert site.upkeep() == []
    assert (robot.rights(), server.rights()) == ({"/camera/left/image": {"publish"}}, {"/camera/left/image": {"read"}})
    robot.graph.append(("topic", "/camera/info", STRING))
    assert site.upkeep() == []
    assert sorted(server.rules("import")) == [("/camera/info", STRING), ("/camera/left/image", IMAGE)]


def test_an_upkeep_without_news_reloads_no_proxy(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    server.sharing.accept(importing("/camera/image"), site.now_s)
    site.upkeep()
    before = robot.reloads, server.reloads
    assert site.upkeep() == []
    assert (robot.reloads, server.reloads) == before


def test_an_offer_is_not_used_before_it_is_accepted(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    site.upkeep()
    ((offer, state),) = server.sharing.offers()
    assert (offer.ros_name, offer.type_name, offer.sender, state) == ("/camera/image", IMAGE, "robot", "offered")
    assert (server.rules("import"), server.held) == ([], [])


def test_only_the_named_sender_is_accepted(site: Site, robot: Machine, server: Machine, stack: ExitStack) -> None:
    arm = site.add("arm")
    arm.start(stack)
    for machine in (arm, robot):
        machine.sharing.expose(machine.exposing("/state", "server", type_name=STRING), site.now_s)
    server.sharing.accept(importing("/*", "robot"), site.now_s)
    (held,) = server.held
    assert held.subject.owner_key.hex() == robot.exposing("/x").owner_key


def test_a_sender_that_is_not_in_the_domain_is_named_and_may_join_later(site: Site, server: Machine) -> None:
    report = server.sharing.accept(importing("/state", "robt"), site.now_s)
    assert any("'robt': no such node" in text and "server" in text for text in report.problems)
    assert [each.source for each in server.sharing.state().accepted] == ["robt"]


def test_of_two_owners_names_the_first_one_stays_in_use(site: Site, robot: Machine, server: Machine) -> None:
    arm = site.add("arm")
    robot.sharing.expose(robot.exposing("/state", "server", type_name=STRING), site.now_s)
    server.sharing.accept(importing("/state"), site.now_s)
    arm.sharing.expose(arm.exposing("/state", "server", type_name=STRING), site.now_s + 1)
    (problem,) = site.upkeep()
    assert problem.startswith(
        "/state from arm: another owner's /state is in use; state prefix: in the proxy.yaml of arm"
    )
    assert [(offer.sender, state) for offer, state in server.sharing.offers()] == [
        ("robot", "used"),
        ("arm", f"not used: {problem.removeprefix('/state from arm: ')}"),
    ]
    assert (len(server.held), server.rules("import")) == (1, [("/state", STRING)])


def test_a_name_that_is_removed_ends_its_rule_and_what_was_installed_for_it(
    site: Site, robot: Machine, server: Machine
) -> None:
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    server.sharing.accept(importing("/camera/image"), site.now_s)
    robot.sharing.stop_exposing("topic", "/camera/image", site.now_s)
    server.sharing.stop_accepting("import", "/camera/image", site.now_s)
    assert (robot.rules("expose"), server.rules("import"), server.held) == ([], [], [])
    assert not (robot.folder / "proxy.yaml.d" / "gdp-share.yaml").exists()


def test_an_exposed_name_is_sent_as_it_was_asked_for(site: Site, robot: Machine) -> None:
    wanted = robot.exposing(
        "/camera/image", type_name=IMAGE, deadline_ms=200.0, repair="never", weight=3, max_bits_s=4e6
    )
    robot.sharing.expose(wanted, site.now_s)
    (rule,) = ProxyConfig.load(robot.path).expose
    assert rule.send_options() == SendOptions(deadline_s=0.2, weight=3, max_bits_s=4e6, repairs=False)


def test_only_a_topic_has_a_deadline(site: Site, robot: Machine) -> None:
    wanted = robot.exposing("/plan", "server", type_name=PLAN, kind="service", deadline_ms=200.0)
    with pytest.raises(LocalError, match="only topics have a deadline"):
        robot.sharing.expose(wanted, site.now_s)


def test_a_second_recipient_is_added_to_an_exposed_name(site: Site, robot: Machine, server: Machine) -> None:
    laptop = site.add("laptop")
    for to in ("server", "laptop"):
        robot.sharing.expose(robot.exposing("/camera/image", to, type_name=IMAGE), site.now_s)
    for machine in (server, laptop):
        machine.sharing.accept(importing("/camera/image"), site.now_s)
        assert machine.rights() == {"/camera/image": {"read"}}
    assert robot.rules("expose") == [("/camera/image", IMAGE)]


def test_a_member_that_joins_later_gets_what_its_group_gets(site: Site, robot: Machine, server: Machine) -> None:
    (robot.folder / "groups.yaml").write_text("vision: [server, laptop]\n")
    robot.sharing.expose(robot.exposing("/camera/image", "vision", type_name=IMAGE), site.now_s)
    laptop = site.add("laptop")
    assert site.upkeep() == []
    assert [offer.ros_name for offer, _ in laptop.sharing.offers()] == ["/camera/image"]


def test_a_name_of_the_file_is_shared_with_its_metadata(site: Site, server: Machine) -> None:
    rule = f"expose: [{{name: /map, type: {STRING}, owner: owner.pub, metadata: {{site: roof}}}}]\n"
    robot = site.add("robot", rule)
    robot.sharing.share(robot.owner, "/map", ["server"], site.now_s, days=30)
    site.upkeep()
    ((offer, _),) = server.sharing.offers()
    assert dict(offer.delegation.metadata or {}).get("site") == "roof"


def test_a_node_may_publish_under_another_owners_name(site: Site, robot: Machine, server: Machine) -> None:
    report = server.sharing.share(
        server.owner, "/goal", ["robot"], site.now_s, type_name=STRING, is_giving=True, days=30
    )
    assert [each.label for each in report.granted] == ["robot"]
    site.upkeep()
    robot.sharing.accept(AcceptedName(side="expose", name="/goal", source="server"), site.now_s)
    assert (robot.rules("expose"), robot.rights()) == ([("/goal", STRING)], {"/goal": {"publish"}})


def test_rights_that_come_later_leave_those_of_before(site: Site, robot: Machine, server: Machine) -> None:
    for is_giving in (False, True):
        robot.sharing.share(
            robot.owner, "/goal", ["server"], site.now_s, type_name=STRING, is_giving=is_giving, days=30
        )
    server.sharing.accept(importing("/goal"), site.now_s)
    assert server.rights() == {"/goal": {"publish", "read"}}


def test_what_is_revoked_ends_at_the_node_and_is_not_given_again(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing("/camera/**", "server"), site.now_s)
    robot.graph.append(("topic", "/camera/image", IMAGE))
    site.upkeep()
    server.sharing.accept(importing("/camera/image"), site.now_s)
    (given,) = server.held
    spread: list[bytes] = []
    robot.sharing.revoke(robot.owner, "/camera/image", "server", kept_in(spread), site.now_s)
    assert [Revocation.from_statement(parse(wire)).fingerprint for wire in spread] == [links_of(given)[0].fingerprint]
    for _ in range(2):
        assert site.upkeep() == []
    assert (server.held, server.rules("import"), server.sharing.offers()) == ([], [], [])
    assert robot.rights() == {"/camera/image": {"publish"}}


def test_a_revocation_covers_the_delegations_before_a_renewal(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.share(robot.owner, "/goal", ["server"], site.now_s, type_name=STRING, days=30)
    site.now_s += 21 * DAY_S
    robot.sharing.work(site.now_s)
    spread: list[bytes] = []
    robot.sharing.revoke(robot.owner, "/goal", "server", kept_in(spread), site.now_s)
    assert len(spread) == 2


def test_a_revocation_that_no_switch_takes_changes_nothing(site: Site, robot: Machine, server: Machine) -> None:
    def refuse(_: object) -> bool:
        raise LocalError("switch.yaml: no revocations folder")

    robot.sharing.share(robot.owner, "/goal", ["server"], site.now_s, type_name=STRING, days=30)
    with pytest.raises(LocalError, match="no revocations folder"):
        robot.sharing.revoke(robot.owner, "/goal", "server", refuse, site.now_s)
    assert [each.is_revoked for each in IssuedStore(robot.owner)] == [False]


def test_a_node_that_is_named_again_gets_a_revoked_name_back(site: Site, robot: Machine, server: Machine) -> None:
    for _ in range(2):
        robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
        site.upkeep()
        assert len(server.sharing.offers()) == 1
        robot.sharing.revoke(robot.owner, "/camera/image", "server", kept_in([]), site.now_s)
        site.upkeep()
        assert server.sharing.offers() == []


def test_delegations_are_renewed_at_two_thirds_of_their_life(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    server.sharing.accept(importing("/camera/image"), site.now_s)
    for _ in range(5):
        before = robot.held, server.held
        site.now_s += 19 * DAY_S
        robot.sharing.work(site.now_s)
        assert [links_of(each) for (each,) in (robot.held, server.held)] == [links_of(each) for (each,) in before]
        site.now_s += 1.5 * DAY_S
        assert site.upkeep() == []
        for machine, (old,) in zip((robot, server), before, strict=True):
            (new,) = machine.held
            assert (new.rights, new.metadata) == (old.rights, old.metadata)
            left_s = links_of(new)[0].validity.not_after_unix_s - site.now_s
            assert 29.9 * DAY_S < left_s <= 30 * DAY_S


def epochs_of(machine: Machine) -> set[int]:
    (held,) = machine.held
    return set(held.grants)


def test_a_name_gets_the_epoch_of_each_day_before_the_day(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    server.sharing.accept(importing("/camera/image"), site.now_s)
    first = int(site.now_s // DAY_S)
    chains = [links_of(each) for (each,) in (robot.held, server.held)]
    for day in range(first + 1, first + 10):
        assert epochs_of(robot) == epochs_of(server)
        assert day in epochs_of(server)
        site.now_s = day * DAY_S + 5.0
        reloads = robot.reloads
        assert site.upkeep() == []
        assert epochs_of(robot) == epochs_of(server) == {day - 1 if day > first + 1 else 0, day, day + 1}
        assert site.upkeep() == []
        assert robot.reloads == reloads + 1  # once a day, and nothing until the next
    assert [links_of(each) for (each,) in (robot.held, server.held)] == chains


def test_a_machine_that_was_off_for_days_gets_the_present_epoch_when_it_is_back(
    site: Site, robot: Machine, server: Machine
) -> None:
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    server.sharing.accept(importing("/camera/image"), site.now_s)
    today = int(site.now_s // DAY_S)
    for day in range(today, today + 5):
        site.now_s = day * DAY_S + 5.0
        robot.sharing.work(site.now_s)
    server.sharing.work(site.now_s)
    assert epochs_of(server) == epochs_of(robot) == {today + 3, today + 4, today + 5}


def test_epochs_wait_for_an_owner_that_was_off_and_a_new_node_gets_those_in_use(
    site: Site, robot: Machine, server: Machine, stack: ExitStack
) -> None:
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    server.sharing.accept(importing("/camera/image"), site.now_s)
    today = int(site.now_s // DAY_S)
    site.now_s += 3 * DAY_S
    site.upkeep()
    assert epochs_of(robot) == epochs_of(server) == {0, today + 1, today + 4}  # today + 1 goes on until tomorrow
    laptop = site.add("laptop")
    laptop.start(stack)
    robot.sharing.share(robot.owner, "/camera/image", ["laptop"], site.now_s, type_name=IMAGE, days=30)
    laptop.sharing.accept(importing("/camera/image"), site.now_s)
    assert epochs_of(laptop) == epochs_of(robot)


def test_a_revoked_node_and_one_that_left_get_no_later_epoch(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    site.add("laptop")
    robot.sharing.share(robot.owner, "/camera/image", ["laptop"], site.now_s, type_name=IMAGE, days=30)
    robot.sharing.revoke(robot.owner, "/camera/image", "server", kept_in([]), site.now_s)
    del site.directory.cards["laptop"]
    before = int(site.now_s // DAY_S) + 1
    site.now_s += 2 * DAY_S
    robot.sharing.work(site.now_s)
    newest = {each.label: max(each.delegation.grants) for each in IssuedStore(robot.owner)}
    assert newest == {"robot": before + 2, "server": before, "laptop": before}


@pytest.mark.parametrize("is_plain", [False, True])
def test_epochs_by_hand_and_those_of_plain_names_stay_as_they_are(
    site: Site, stack: ExitStack, *, is_plain: bool
) -> None:
    robot, server = site.add("robot", "" if is_plain else "epochs: manual\n"), site.add("server")
    robot.start(stack)
    wanted = robot.exposing("/camera/image", "server", type_name=IMAGE)
    robot.sharing.expose(wanted, site.now_s, is_plain=is_plain)
    server.sharing.accept(importing("/camera/image"), site.now_s)
    site.now_s += 3 * DAY_S
    robot.sharing.work(site.now_s)
    assert epochs_of(robot) == epochs_of(server) == {0}


def test_a_machine_that_has_left_the_domain_gets_no_renewal(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    del site.directory.cards["server"]
    site.now_s += 21 * DAY_S
    assert [each.label for each in robot.sharing.work(site.now_s).granted] == ["robot"]


def test_what_could_not_be_delivered_is_delivered_later(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    server.sharing.accept(importing("/camera/image"), site.now_s)
    site.now_s += 21 * DAY_S
    site.directory.is_down = True
    problems = robot.sharing.work(site.now_s).problems
    assert "/camera/image is not delivered to server yet: the domain's server does not answer" in problems
    site.directory.is_down = False
    assert site.upkeep() == []
    (held,) = server.held
    assert links_of(held)[0].validity.not_after_unix_s > site.now_s + 29 * DAY_S


def test_without_a_proxy_the_rules_are_written_for_its_start(site: Site, server: Machine) -> None:
    robot = site.add("robot")
    report = robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    assert report.is_running is False
    assert robot.rules("expose") == [("/camera/image", IMAGE)]


def test_rules_that_the_proxy_refuses_leave_everything_as_it_was(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing("/camera/image", "server", type_name=IMAGE), site.now_s)
    before = robot.rules("expose"), robot.sharing.state()
    robot.refusal = "expose[1]: no"
    with pytest.raises(LocalError, match=r"the proxy refused the change: expose\[1\]: no"):
        robot.sharing.expose(robot.exposing("/map", "server", type_name=STRING), site.now_s)
    assert (robot.rules("expose"), robot.sharing.state()) == before
    assert len(list(IssuedStore(robot.owner))) == 2


@pytest.mark.parametrize(
    ("name", "to", "fields", "expected"),
    [
        ("camera", "server", {}, "expected a full ROS name"),
        ("/camera//x", "server", {}, "expected a full ROS name"),
        ("/new", "sevrer", {}, "'sevrer': no such node or group in the domain; there are: robot, server"),
        ("/new", "server", {"type_name": PLAN}, "expected the type of a topic as ROS 2 writes it"),
        ("/written", "server", {}, r"/written is exposed already by .*proxy.yaml:8:5"),
        ("/taken", "server", {}, r"/taken is imported by .*proxy.yaml:10:5: one machine gives a topic or takes it"),
        ("/mine", "server", {}, "/mine is exposed already to server"),
        ("/mine", "robot", {"type_name": IMAGE}, "/mine is exposed already with type std_msgs/msg/String"),
        ("/mine", "robot", {"owner_key": "02" * 33}, "/mine is exposed already under the owner in"),
        ("/asked", "server", {}, "'gdp import /asked': one machine gives a topic or takes it, not both"),
    ],
)
def test_a_name_that_cannot_be_exposed_is_refused_with_a_sentence(
    site: Site, server: Machine, name: str, to: str, fields: dict[str, str], expected: str
) -> None:
    rule = f"{{name: %s, type: {STRING}, owner: owner.pub}}"
    robot = site.add("robot", f"expose:\n  - {rule % '/written'}\nimport:\n  - {rule % '/taken'}\n")
    robot.sharing.expose(robot.exposing("/mine", "server", type_name=STRING), site.now_s)
    server.sharing.share(server.owner, "/asked", ["robot"], site.now_s, type_name=STRING, days=30)
    robot.sharing.accept(importing("/asked"), site.now_s)
    before = robot.sharing.state()
    with pytest.raises(LocalError, match=expected):
        robot.sharing.expose(robot.exposing(name, to).model_copy(update=fields), site.now_s)
    assert robot.sharing.state() == before


def test_a_name_that_cannot_be_imported_is_refused_with_a_sentence(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.expose(robot.exposing("/mine", "server", type_name=STRING), site.now_s)
    robot.sharing.accept(importing("/asked"), site.now_s)
    for name, expected in (
        ("/mine", "is exposed by 'gdp expose /mine': one machine gives a topic or takes it, not both"),
        ("/asked", "/asked is accepted already"),
        ("mine", "expected a full ROS name"),
    ):
        with pytest.raises(LocalError, match=expected):
            robot.sharing.accept(importing(name), site.now_s)


def test_a_name_without_a_known_type_is_not_shared(site: Site, robot: Machine, server: Machine) -> None:
    with pytest.raises(LocalError, match="/unknown: its type is not known here: state --type"):
        robot.sharing.share(robot.owner, "/unknown", ["server"], site.now_s, days=30)
    with pytest.raises(LocalError, match=r"/unknown/\*: no rule of this machine matches it"):
        robot.sharing.share(robot.owner, "/unknown/*", ["server"], site.now_s, days=30)
    with pytest.raises(LocalError, match="/unknown is not shared with server"):
        robot.sharing.revoke(robot.owner, "/unknown", "server", kept_in([]), site.now_s)


def test_mail_that_is_no_delegation_to_this_node_is_reported_and_not_stored(
    site: Site, robot: Machine, server: Machine
) -> None:
    laptop = site.add("laptop")
    robot.sharing.share(robot.owner, "/goal", ["laptop"], site.now_s, type_name=STRING, days=30)
    (foreign,) = site.directory.mail.pop(site.directory.cards["laptop"].name)
    to = site.directory.cards["server"].name
    for kind, data in (
        (MailKind.DELEGATION.value, foreign.data),
        (MailKind.DELEGATION.value, foreign.data[:-20] + bytes(20)),
        (MailKind.DELEGATION.value, b""),
        (MailKind.REVOCATION.value, foreign.data),
        ("news", b"unknown kinds are skipped"),
    ):
        site.directory.mail[to].append(Mail(sender="robot", kind=kind, data=data))
    problems = server.sharing.work(site.now_s).problems
    assert len(problems) == 4
    assert all(text.startswith("mail from robot is not taken: ") for text in problems)
    assert (server.sharing.offers(), laptop.sharing.offers()) == ([], [])


def test_an_older_delegation_that_comes_late_replaces_nothing(site: Site, robot: Machine, server: Machine) -> None:
    robot.sharing.share(robot.owner, "/goal", ["server"], site.now_s, type_name=STRING, days=30)
    (early,) = site.directory.mail.pop(site.directory.cards["server"].name)
    site.now_s += 21 * DAY_S
    site.upkeep()
    site.upkeep()
    ((offer, _),) = server.sharing.offers()
    site.directory.mail[site.directory.cards["server"].name].append(early)
    site.upkeep()
    ((again, _),) = server.sharing.offers()
    assert again.until_unix_s == offer.until_unix_s
