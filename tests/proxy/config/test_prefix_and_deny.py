"""Keys ``prefix`` and ``deny`` of ``proxy.yaml``: what a name is called, and what never crosses."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.metadata import Metadata
from gdp.names import Name
from gdp.ros_names import covers
from gdp.trust.right import Right
from proxy.bridge.core.desired_flows import DeniedName, denied, exposed, imported
from proxy.check.core.explain import explain
from proxy.config.config import ProxyConfig
from proxy.endpoints.core.endpoint import GraphEntity, Role
from tests.proxy.check.core.test_explain import Given
from tests.proxy.rule_files import FIRST_LINE, OWNER, furnish, proxy, refusals, rules

STRING = "std_msgs/msg/String"
ROS = "ros: {endpoint: ros2, domain: 0}\n"
GRAPH = frozenset(
    GraphEntity(Role.PUBLISHES, name, STRING, "/node", key=name) for name in ("/open", "/secret/key", "/secret/_x")
)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    furnish(tmp_path)
    return tmp_path


def crossing(config: ProxyConfig) -> list[str]:
    return [flow.local for flow in exposed(config.expose, GRAPH, [])]


def metadata(name: str) -> Metadata:
    return Metadata({"kind": "topic", "name": name, "type": STRING})


def held(name: str) -> dict[Name, Given]:
    return {metadata(name).name(OWNER.public.compressed): Given(metadata(name), frozenset({Right.READ}))}


def test_the_prefix_of_the_file_stands_before_each_name(place: Path) -> None:
    config = proxy(place, f"prefix: robot1\nexpose:\n{rules(f'name: /scan, type: {STRING}')}")
    rule = config.expose[0]
    assert (rule.local, rule.overlay_metadata["name"]) == ("/scan", "/robot1/scan")


def test_a_rule_may_have_another_prefix_or_none(place: Path) -> None:
    texts = (f"name: /a, type: {STRING}, prefix: ''", f"name: /a, type: {STRING}, prefix: fleet/robot2, remap: /b")
    config = proxy(place, f"prefix: robot1\nimport:\n{rules(*texts)}")
    assert [rule.overlay_metadata["name"] for rule in config.imports] == ["/a", "/fleet/robot2/a"]


def test_a_remapped_name_has_the_prefix_on_the_overlay_alone(place: Path) -> None:
    config = proxy(place, f"prefix: robot1\nexpose:\n{rules(f'name: /joints, remap: /arm/state, type: {STRING}')}")
    assert config.expose[0].global_name_of("/arm/state") == "/robot1/joints"


def test_a_prefix_applies_to_drop_ins(place: Path) -> None:
    (place / "proxy.yaml.d").mkdir()
    (place / "proxy.yaml.d" / "a.yaml").write_text(
        f"deny: [/hidden]\nexpose:\n- {{name: /scan, type: {STRING}, owner: ../owner.pub}}\n"
    )
    config = proxy(place, "prefix: robot1\n")
    assert config.expose[0].overlay_metadata["name"] == "/robot1/scan"
    assert config.deny == ("/hidden",)


@pytest.mark.parametrize("text", ["/robot1", "robot1/", "a b", "robot*", "a//b"])
def test_what_is_no_namespace_is_refused(place: Path, text: str) -> None:
    expected = "expected a namespace without its first slash, such as robot1 or fleet/robot1"
    assert refusals(place, f"prefix: '{text}'\n") == [f"proxy.yaml:{FIRST_LINE}:9: prefix: {expected}"]


def test_two_rules_that_give_one_name_under_their_prefixes_are_refused(place: Path) -> None:
    texts = (f"name: /robot1/a, type: {STRING}", f"name: /a, type: {STRING}, prefix: robot1")
    assert "gives the same name" in refusals(place, f"import:\n{rules(*texts)}")[0]


def test_a_denied_name_is_not_exposed_whatever_the_rules_say(place: Path) -> None:
    texts = ("name: /**", f"name: /secret/key, type: {STRING}", f"name: /secret/_x, type: {STRING}")
    config = proxy(place, f"{ROS}deny: ['/secret/**']\nexpose:\n{rules(*texts)}")
    assert crossing(config) == ["/open"]


def test_a_denied_name_is_not_imported(place: Path) -> None:
    texts = (f"name: /secret/key, type: {STRING}", "name: /**")
    config = proxy(place, f"{ROS}deny: ['/secret/**']\nimport:\n{rules(*texts)}")
    both = [(metadata(name), metadata(name).name(OWNER.public.compressed)) for name in ("/secret/a", "/open")]
    assert [flow.local for flow in imported(config.imports, frozenset(), both, [])] == ["/open"]


@pytest.mark.parametrize("pattern", ["/robot1/secret/**", "/secret/*"])
def test_a_name_is_denied_with_its_prefix_and_without(place: Path, pattern: str) -> None:
    config = proxy(place, f"{ROS}prefix: robot1\ndeny: ['{pattern}']\nexpose:\n{rules('name: /**')}")
    assert crossing(config) == ["/open"]


def test_denied_names_are_counted_with_their_pattern(place: Path) -> None:
    config = proxy(
        place, f"{ROS}deny: ['/secret/*']\nexpose:\n{rules('name: /**', f'name: /secret/a, type: {STRING}')}"
    )
    assert list(denied(config.expose, GRAPH, is_exposed=True)) == [
        DeniedName(True, "/secret/a", "/secret/*"),
        DeniedName(True, "/secret/key", "/secret/*"),
    ]


def test_check_shows_what_is_denied_of_the_graph_and_of_delegations(place: Path) -> None:
    config = proxy(place, f"{ROS}deny: ['/secret/*']\nexpose:\n{rules('name: /**')}import:\n{rules('name: /**')}")
    out, into = explain(config.expose, config.imports, GRAPH, held("/secret/b"))
    assert out.denied == (("/secret/key", "/secret/*"),)
    assert into.denied == (("/secret/b", "/secret/*"),)
    assert into.notes[0] == "denied, hence left alone: 1: /secret/b (/secret/*)"


@pytest.mark.parametrize(
    ("pattern", "name"), [("/a/**", "/a/_b/c"), ("/a/*", "/a/_b"), ("/a/*b", "/a/_b"), ("/a", "/a")]
)
def test_a_denied_pattern_covers_hidden_segments(pattern: str, name: str) -> None:
    assert covers(pattern, name)
    assert not covers(pattern, "/other")
