"""Explanation of rules with the live graph and the stored delegations."""

from __future__ import annotations

import io
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import orjson
import pytest
import typer
from rich.console import Console

from gdp.cli import gdp
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.trust.right import Right
from proxy.check.command import table
from proxy.check.core.explain import explain, unknown_qos
from proxy.check.core.finding import Finding, Match
from proxy.endpoints.core.endpoint import GraphEntity, Role, proxy_node_name
from proxy.serial.channel import Qos
from tests.proxy.rule_files import OWNER, furnish, proxy, rules

IMAGE, STRING = "sensor_msgs/msg/Image", "std_msgs/msg/String"
RELIABLE = Qos(depth=10, reliability="reliable", durability="volatile", deadline=(0, 0), lifespan=(0, 0), lease=(0, 0))
BEST_EFFORT = Qos(
    depth=10, reliability="best_effort", durability="volatile", deadline=(0, 0), lifespan=(0, 0), lease=(0, 0)
)
LATCHED = Qos(
    depth=1, reliability="reliable", durability="transient_local", deadline=(0, 0), lifespan=(0, 0), lease=(0, 0)
)


@dataclass(frozen=True, slots=True)
class Given:
    """Delegation with the fields that an explanation uses."""

    metadata: Metadata | None
    rights: frozenset[Right]


def given(right: Right, kind: str = "topic", name: str = "/image", type_name: str = IMAGE) -> dict[Name, Given]:
    metadata = Metadata({"kind": kind, "name": name, "type": type_name})
    return {metadata.name(OWNER.public.compressed): Given(metadata, frozenset({right}))}


def end(
    role: Role, name: str = "/image", type_name: str = IMAGE, node: str = "/node", qos: Qos | None = None
) -> GraphEntity:
    return GraphEntity(role, name, type_name, node, key=f"{node}{name}{type_name}", qos=qos)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    furnish(tmp_path)
    return tmp_path


def findings(
    place: Path,
    side: str,
    texts: Iterable[str],
    ends: Iterable[GraphEntity] = (),
    held: Mapping[Name, Given] | None = None,
) -> list[Finding]:
    config = proxy(place, f"ros: {{endpoint: ros2, domain: 0}}\n{side}:\n{rules(*texts)}")
    return explain(config.expose, config.imports, frozenset(ends), held or {})


def only(
    place: Path, side: str, text: str, ends: Iterable[GraphEntity] = (), held: Mapping[Name, Given] | None = None
) -> Match:
    (finding,) = findings(place, side, [text], ends, held)
    (match,) = finding.matches
    return match


def test_a_rule_that_works_has_no_fault(place: Path) -> None:
    held = given(Right.PUBLISH)
    match = only(place, "expose", f"name: /image, type: {IMAGE}", [end(Role.PUBLISHES, qos=BEST_EFFORT)], held)
    assert (match.local, match.type_name, match.nodes) == ("/image", IMAGE, ("/node",))
    assert match.qos == ("best effort, volatile",)
    assert [match.overlay] == list(held)
    assert (match.is_held, match.faults, match.notes) == (True, (), ())


def test_a_type_that_is_not_stated_is_the_one_found(place: Path) -> None:
    held = given(Right.PUBLISH)
    match = only(place, "expose", "name: /image", [end(Role.PUBLISHES)], held)
    assert (match.type_name, match.is_held, match.faults) == (IMAGE, True, ())


def test_a_topic_without_a_publisher_is_described_as_such(place: Path) -> None:
    match = only(place, "expose", f"name: /image, type: {IMAGE}", [end(Role.SUBSCRIBES)], given(Right.PUBLISH))
    assert (match.nodes, match.faults, match.notes) == ((), (), ("nothing here publishes it now",))
    (finding,) = findings(place, "expose", ["name: /camera/*"])
    assert (finding.matches, finding.notes) == ((), ("nothing here matches it yet",))


def test_without_a_graph_nothing_is_missing(place: Path) -> None:
    config = proxy(place, f"expose:\n{rules(f'name: /image, type: {IMAGE}', 'name: /camera/*')}")
    one, other = explain(config.expose, config.imports, None, given(Right.PUBLISH))
    assert one.matches[0].notes == one.notes == other.notes == ()


def test_another_type_than_the_rules_is_a_fault(place: Path) -> None:
    ends = [end(Role.PUBLISHES, type_name=STRING)]
    match = only(place, "expose", f"name: /image, type: {IMAGE}", ends, given(Right.PUBLISH))
    assert match.faults == (f"a node here publishes it as {STRING}; the rule says {IMAGE}",)
    (finding,) = findings(place, "expose", [f"name: /*, type: {IMAGE}"], ends)
    assert finding.notes == (f"what matches here is {STRING}, not {IMAGE}",)


def test_several_types_under_one_name_are_a_fault_of_each(place: Path) -> None:
    ends = [end(Role.PUBLISHES), end(Role.PUBLISHES, type_name=STRING, node="/other")]
    (finding,) = findings(place, "expose", ["name: /image"], ends, given(Right.PUBLISH))
    assert [match.type_name for match in finding.matches] == [IMAGE, STRING]
    assert [match.nodes for match in finding.matches] == [("/node",), ("/other",)]
    assert all("too: say in the rule which type is meant" in match.faults[0] for match in finding.matches)
    two = findings(place, "expose", [f"name: /image, type: {each}" for each in (IMAGE, STRING)], ends)
    assert not any("publishes it as" in fault for each in two for fault in each.matches[0].faults)


def test_a_name_is_of_the_rule_that_holds_for_it(place: Path) -> None:
    ends = [end(Role.PUBLISHES), end(Role.PUBLISHES, "/other")]
    wide, narrow = findings(place, "expose", ["name: /**", "name: /image"], ends)
    assert [match.local for match in wide.matches] == ["/other"]
    assert [match.local for match in narrow.matches] == ["/image"]


def test_without_a_delegation_the_command_that_makes_one_is_shown(place: Path) -> None:
    text = f"name: /image, type: {IMAGE}, metadata: {{author: the lab, site: roof, pin: 7}}"
    (fault,) = only(place, "expose", text).faults
    assert fault.startswith("no delegation; its owner makes one with: gdp delegate name --owner OWNER")
    words = fault.partition(" gdp ")[2]
    assert f"--kind topic --name /image --type {IMAGE} --author 'the lab' --meta site=roof --pin 7" in words
    _understood(words)


def test_metadata_that_no_option_states_are_shown_as_they_are(place: Path) -> None:
    (fault,) = only(place, "expose", f"name: /image, type: {IMAGE}, metadata: {{storey: 3}}").faults
    assert "makes one for these metadata" in fault
    assert "'storey': 3" in fault


@pytest.mark.parametrize(
    ("side", "text", "held", "fault"),
    [
        ("expose", f"name: /image, type: {IMAGE}", given(Right.READ), "the delegation gives read, not publish"),
        ("import", f"name: /image, type: {IMAGE}", given(Right.PUBLISH), "the delegation gives publish, not read"),
        (
            "expose",
            "name: /set, kind: service, type: std_srvs/srv/SetBool",
            given(Right.READ, "service", "/set", "std_srvs/srv/SetBool"),
            "the delegation gives read, not serve",
        ),
        (
            "import",
            "name: /set, kind: service, type: std_srvs/srv/SetBool",
            given(Right.SERVE, "service", "/set", "std_srvs/srv/SetBool"),
            "the delegation gives serve, not call",
        ),
    ],
)
def test_a_delegation_of_another_right_is_a_fault(
    place: Path, side: str, text: str, held: Mapping[Name, Given], fault: str
) -> None:
    match = only(place, side, text, held=held)
    assert (match.is_held, match.faults) == (False, (fault,))


def test_a_pattern_on_import_means_the_delegations_that_fit(place: Path) -> None:
    held = {**given(Right.READ), **given(Right.READ, name="/info"), **given(Right.READ, name="/a/b")}
    held |= given(Right.PUBLISH, name="/mine")
    (finding,) = findings(place, "import", ["name: /*"], [end(Role.SUBSCRIBES)], held)
    assert [(match.local, match.is_held, match.nodes) for match in finding.matches] == [
        ("/image", True, ("/node",)),
        ("/info", True, ()),
    ]


def test_a_delegation_that_does_not_say_what_it_is_for_is_found_by_a_full_rule_only(place: Path) -> None:
    held = {name: Given(None, each.rights) for name, each in given(Right.READ).items()}
    assert only(place, "import", f"name: /image, type: {IMAGE}", held=held).is_held
    (finding,) = findings(place, "import", ["name: /*"], held=held)
    assert finding.notes == (
        "no delegation held fits it, and nothing here asks for it",
        "delegations that do not say what they are for: 1; only a rule with a full name and type finds them",
    )


def test_what_is_wanted_here_but_not_given_is_shown(place: Path) -> None:
    match = only(place, "import", "name: /*", [end(Role.SUBSCRIBES)])
    assert not match.is_held
    assert "--right read" in match.faults[0]


def test_another_proxys_virtual_node_is_left_alone(place: Path) -> None:
    virtual = end(Role.PUBLISHES, node="/" + proxy_node_name("ab" * 32))
    (finding,) = findings(place, "expose", ["name: /image"], [virtual])
    assert finding.matches == ()
    assert "of another proxy, hence left alone: /image" in finding.notes
    match = only(place, "expose", "name: /image", [virtual, end(Role.PUBLISHES)], given(Right.PUBLISH))
    assert match.nodes == ("/node",)


@pytest.mark.parametrize(
    ("text", "qos", "fault"),
    [
        ("reliable: false", RELIABLE, "/node asks for reliable, and the rule says reliable: false"),
        ("latched: false", LATCHED, "/node asks for transient local, and the rule says latched: false"),
    ],
)
def test_a_reader_that_asks_for_more_than_the_rule_lets_offer_is_a_fault(
    place: Path, text: str, qos: Qos, fault: str
) -> None:
    held = given(Right.READ)
    ends = [end(Role.SUBSCRIBES, qos=qos)]
    assert only(place, "import", f"name: /image, type: {IMAGE}, {text}", ends, held).faults == (fault,)
    assert only(place, "import", f"name: /image, type: {IMAGE}", ends, held).faults == ()


def test_reliability_cannot_be_added_to_what_comes_best_effort(place: Path) -> None:
    ends = [end(Role.PUBLISHES, qos=BEST_EFFORT)]
    match = only(place, "expose", f"name: /image, type: {IMAGE}, reliable: true", ends, given(Right.PUBLISH))
    assert match.notes == ("/node offers best effort: what is lost before the proxy stays lost",)


def test_a_latched_depth_that_dds_does_not_tell_is_named(place: Path) -> None:
    unknown = replace(LATCHED, history="unknown", depth=0)
    match = only(place, "expose", f"name: /image, type: {IMAGE}", [end(Role.PUBLISHES, qos=unknown)])
    assert match.notes == (
        "DDS does not tell its depth: the proxy counts what a late reader gets; the rule's 'history' sets it",
    )
    match = only(place, "expose", f"name: /image, type: {IMAGE}, history: 5", [end(Role.PUBLISHES, qos=unknown)])
    assert match.notes == ()


@pytest.mark.parametrize(
    ("more", "is_named"),
    [
        ("", True),
        (", reliable: true", True),
        (", latched: false", False),
        (", latched: true", False),
        (", offered: {reliability: reliable, durability: transient_local, depth: 1}", False),
    ],
)
def test_an_import_whose_first_qos_no_rule_states_is_named(place: Path, more: str, is_named: bool) -> None:
    config = proxy(
        place, f"ros: {{endpoint: ros2}}\nimport:\n{rules('kind: service, name: /plan', 'name: /map' + more)}"
    )
    assert unknown_qos(config.imports) == ["/map"] * is_named


def test_an_action_is_known_by_its_goals(place: Path) -> None:
    ends = [
        end(Role.SERVES, "/fold/_action/send_goal", "test_msgs/action/Fibonacci_SendGoal"),
        end(Role.SERVES, "/fold/_action/get_result", "test_msgs/action/Fibonacci_GetResult"),
        end(Role.PUBLISHES, "/fold/_action/feedback", "test_msgs/action/Fibonacci_FeedbackMessage"),
    ]
    texts = ["name: /**, kind: action", "name: /**, kind: service", "name: /**"]
    action, service, topic = findings(place, "expose", texts, ends)
    assert [(match.local, match.type_name) for match in action.matches] == [("/fold", "test_msgs/action/Fibonacci")]
    assert service.matches == topic.matches == ()


def test_what_a_pattern_leaves_out_because_every_node_has_it_is_named(place: Path) -> None:
    ends = [end(Role.SERVES, f"/node/{each}_parameters", "std_srvs/srv/SetBool") for each in ("get", "set")]
    ends.append(end(Role.SERVES, "/node/do", "std_srvs/srv/SetBool"))
    (finding,) = findings(place, "expose", ["kind: service, name: /**"], ends)
    assert [match.local for match in finding.matches] == ["/node/do"]
    said = "every node has it, so name it in full if it is to cross: 2: /node/get_parameters, /node/set_parameters"
    assert finding.notes == (said,)
    (full,) = findings(place, "expose", ["kind: service, name: /node/get_parameters"], ends)
    assert [match.local for match in full.matches] == ["/node/get_parameters"]


def test_a_type_that_is_not_known_yet_is_said_to_be_so(place: Path) -> None:
    match = only(place, "expose", "name: /image", [end(Role.PUBLISHES, type_name="")])
    assert (match.overlay, match.notes) == (None, ("its type is not known yet",))
    stated = only(place, "expose", f"name: /image, type: {IMAGE}", [end(Role.PUBLISHES, type_name="")])
    assert stated.nodes == ("/node",)


def test_a_finding_has_a_json_form(place: Path) -> None:
    (finding,) = findings(place, "expose", [f"name: /image, type: {IMAGE}"], [end(Role.PUBLISHES, qos=RELIABLE)])
    fields = orjson.loads(orjson.dumps(finding.to_fields()))
    assert (fields["direction"], fields["kind"], fields["rule"]) == ("expose", "topic", "/image")
    (match,) = fields["matches"]
    assert match["overlay"] == finding.matches[0].overlay.to_text()  # type: ignore[union-attr]
    assert (match["nodes"], match["qos"], match["held"]) == (["/node"], ["reliable, volatile"], False)


def test_the_table_shows_names_and_what_there_is_to_say(place: Path) -> None:
    reported = io.StringIO()
    given_rules = [f"name: /image, type: {IMAGE}", "name: /camera/*"]
    found = findings(place, "expose", given_rules, [end(Role.PUBLISHES)], given(Right.PUBLISH))
    Console(file=reported, width=160).print(table(found))
    shown = reported.getvalue()
    assert found[0].matches[0].overlay.short in shown  # type: ignore[union-attr]
    assert "expose /camera/*: nothing here matches it yet" in shown


def _understood(words: str) -> None:
    """Parse a command line of ``gdp`` like the command, without running it."""
    command = typer.main.get_command(gdp.app)
    program, group, *rest = shlex.split(words)
    command.commands[program].commands[group].make_context(group, rest)  # type: ignore[attr-defined]
