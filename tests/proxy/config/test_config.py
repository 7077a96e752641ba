"""proxy.yaml, as people write it; its rules are tested in test_rules."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.metadata import Metadata
from tests.proxy.rule_files import OTHER, OWNER, furnish, proxy, refusals, rules

RULE = "  - {name: /camera/image, type: sensor_msgs/msg/Image, metadata: {author: lab}, owner: owner.pub}\n"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    furnish(tmp_path)
    return tmp_path


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for key in ("ROS_DOMAIN_ID", "ROS_MASTER_URI"):
        monkeypatch.delenv(key, raising=False)


def refusal(place: Path, text: str) -> str:
    (line,) = refusals(place, text)
    return line


def test_a_rule_needs_only_what_names_the_topic(place: Path) -> None:
    (rule,) = proxy(place, "expose:\n" + RULE).expose
    assert (rule.encoding, rule.reliable, rule.latched, rule.is_global) == ("json", True, False, True)
    assert rule.max_bytes == MESSAGE_MAX_BYTES


def test_the_overlay_name_follows_from_metadata_and_owner(place: Path) -> None:
    (rule,) = proxy(place, "import:\n" + RULE).imports
    metadata = {"kind": "topic", "name": "/camera/image", "type": "sensor_msgs/msg/Image", "author": "lab"}
    assert rule.overlay_name == Metadata(metadata).name(OWNER.public.compressed)


def test_the_file_may_state_the_owner_of_all_its_names(place: Path) -> None:
    own = RULE.replace("owner.pub", "other.pub")
    config = proxy(place, f"owner: owner.pub\nexpose:\n  - {{name: /a}}\n{own}import:\n  - {{name: /b}}\n")
    assert [rule.owner for rule in (*config.expose, *config.imports)] == [OWNER.public, OTHER.public, OWNER.public]
    assert refusal(place, "expose:\n  - {name: /a}\n").endswith(": expose[0].owner: required, but not there")
    assert "owner: expected an owner's public key file" in refusal(place, "owner: missing.pub\n")


def test_a_graph_may_be_said_to_have_no_other_proxy(place: Path) -> None:
    text = "ros:\n  - {endpoint: ros2, domain: 1}\n  - {endpoint: ros2, domain: 2, exclusive: true}\n"
    first, second = proxy(place, text).ros
    assert (first.exclusive, second.exclusive) == (False, True)


def test_what_a_rule_may_say_it_says(place: Path) -> None:
    text = RULE.replace("}\n", ", encoding: cdr, reliable: false, latched: true, max_bytes: 100, global: false}\n")
    (rule,) = proxy(place, "expose:\n" + text).expose
    assert (rule.encoding, rule.reliable, rule.latched, rule.max_bytes) == ("cdr", False, True, 100)
    assert not rule.is_global


def test_the_same_topic_may_leave_and_arrive(place: Path) -> None:
    config = proxy(place, f"expose:\n{RULE}import:\n{RULE}")
    assert config.expose[0].overlay_name == config.imports[0].overlay_name


def test_a_recording_is_of_what_is_imported(place: Path) -> None:
    config = proxy(place, f"import:\n{RULE}record: {{path: out.mcap}}\n")
    assert config.record is not None
    assert (config.record.path, config.record.format) == (place / "out.mcap", "mcap")
    assert refusal(place, "record: {path: out.mcap}\n").endswith(
        ":9: record: there is nothing to record without a rule under import"
    )


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("sensor_msgs/msg/Image", "Image"), "33: type: expected the type of a topic as ROS 2 writes it"),
        (("name: /camera/image", "name: ''"), "12: name: "),
        (("{author: lab}", "{type: x}"), "66: metadata: type: state it as a key of the rule"),
        (("{author: lab}", "{author: [x]}"), "75: metadata.author: expected a text or a whole number"),
        (("owner.pub", "id"), "88: owner: expected an owner's public key file: "),
        (("owner.pub", "root.crt"), "88: owner: expected an owner's public key file: "),
        (("owner: owner.pub", "owner: 5"), "88: owner: "),
        (("owner: owner.pub", "encoding: xml, owner: owner.pub"), "91: encoding: expected 'json'"),
        ((", owner: owner.pub", ""), "5: owner: required, but not there"),
        (("owner: owner.pub", "qos: 1, owner: owner.pub"), "81: qos: unknown key; expected one of"),
    ],
)
def test_a_wrong_rule_is_reported_with_its_position(place: Path, change: tuple[str, str], complaint: str) -> None:
    reported = refusal(place, "expose:\n" + RULE.replace(*change))
    assert reported.removeprefix("proxy.yaml:6:").replace("expose[0].", "").startswith(complaint)


def test_a_private_key_is_not_an_owner(place: Path) -> None:
    (place / "owner.pub").write_bytes(OWNER.to_pem())
    assert "expected an owner's public key file" in refusal(place, "expose:\n" + RULE)


def test_without_a_graph_there_are_only_recordings(place: Path) -> None:
    config = proxy(place, "expose:\n" + RULE)
    assert config.ros == ()
    with pytest.raises(LocalError, match="no graph is stated under ros"):
        config.endpoint_of(config.expose[0])


@pytest.mark.parametrize("more", ["kind: service", "ros: 2", "domain: 0"])
def test_a_rule_that_only_a_graph_can_fulfil_needs_one(place: Path, more: str) -> None:
    text = "expose:\n" + rules(f"name: /a, {more}")
    assert refusal(place, text) == "proxy.yaml:6:5: expose[0]: no graph is stated under ros"
    config = proxy(place, text + "ros: {endpoint: ros2, domain: 0}\n")
    assert config.endpoint_of(config.expose[0]) == 0


@pytest.mark.parametrize("text", ["ros: {endpoint: dds, domain: 7}", "ros: [{endpoint: dds, domain: 7}]"])
def test_one_graph_may_be_written_with_or_without_a_list(place: Path, text: str) -> None:
    (end,) = proxy(place, text).ros
    assert (end.endpoint, end.ros, end.domain_id) == ("dds", 2, 7)


def test_what_a_graph_leaves_open_is_read_from_the_environment(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    two, one = proxy(place, "ros: [{endpoint: ros2}, {endpoint: ros1}]").ros
    assert (two.where, one.where) == ((2, 0), (1, "http://localhost:11311"))
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    monkeypatch.setenv("ROS_MASTER_URI", "http://robot:11411")
    assert (two.where, one.where) == ((2, 42), (1, "http://robot:11411"))
    stated = proxy(place, "ros: [{endpoint: ros2, domain: 1}, {endpoint: ros1, master: 'http://lab:1'}]").ros
    assert [end.where for end in stated] == [(2, 1), (1, "http://lab:1")]


def test_a_wrong_domain_in_the_environment_is_reported(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "robot")
    reported = refusal(place, "ros: {endpoint: ros2}\n")
    assert reported == "proxy.yaml:5:6: ros: the environment's ROS_DOMAIN_ID is 'robot', not a number from 0 to 232"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("1", "6: ros: expected a mapping such as {endpoint: ros2, domain: 0}, or a list of such"),
        ("2", "6: ros: expected a mapping such as {endpoint: ros2, domain: 0}, or a list of such"),
        ("ros2", "6: ros: expected a mapping such as {endpoint: ros2, domain: 0}, or a list of such"),
        ("null", "6: ros: expected a mapping such as {endpoint: ros2, domain: 0}, or a list of such"),
        ("{domain: 0}", "6: ros.endpoint: required, but not there"),
        ("{endpoint: dds, domain: 233}", "30: ros.domain: expected less than or equal to 232, not 233"),
        ("{endpoint: ros, domain: 0}", "17: ros.endpoint: expected 'ros2', 'ros1' or 'dds', not 'ros'"),
        ("{endpoint: ros2, id: 0}", "23: ros.id: unknown key; expected one of endpoint, domain, master, exclusive"),
        (
            "[{endpoint: ros2, id: 0}]",
            "24: ros[0].id: unknown key; expected one of endpoint, domain, master, exclusive",
        ),
        ("{endpoint: ros1, domain: 0}", "31: ros.domain: ROS 1 has no domains; it has a master"),
        ("{endpoint: ros2, master: 'http://a:1'}", "31: ros.master: ROS 2 has no master; it has a domain"),
        ("{endpoint: ros1, master: robot}", "31: ros.master: expected a URI such as http://localhost:11311"),
        ("{endpoint: ros1, master: 'http://a:b'}", "31: ros.master: expected a URI such as http://localhost:11311"),
        ("[{endpoint: ros2}, {endpoint: dds, domain: 0}]", "25: ros[1]: ros[0] is the same graph"),
        ("[{endpoint: ros1}, {endpoint: ros1}]", "25: ros[1]: ros[0] is the same graph"),
    ],
)
def test_a_wrong_graph_is_reported_with_its_position(place: Path, text: str, complaint: str) -> None:
    assert refusal(place, f"ros: {text}\n") == f"proxy.yaml:5:{complaint}"


THREE = "ros: [{endpoint: ros2, domain: 0}, {endpoint: dds, domain: 7}, {endpoint: ros1}]\n"


@pytest.mark.parametrize(
    ("more", "index"), [("domain: 0", 0), ("domain: 7", 1), ("ros: 2, domain: 7", 1), ("ros: 1", 2)]
)
def test_a_rule_says_which_graph_it_is_about(place: Path, more: str, index: int) -> None:
    config = proxy(place, f"{THREE}import:\n{rules(f'name: /a, {more}')}")
    assert config.endpoint_of(config.imports[0]) == index


@pytest.mark.parametrize(
    ("more", "complaint"),
    [
        ("", "several graphs under ros fit; say which: ros: 1 or 2, domain: its number"),
        (", ros: 2", "several graphs under ros fit; say which: ros: 1 or 2, domain: its number"),
        (", domain: 3", "none of the graphs under ros fits"),
        (", ros: 1, domain: 0", "none of the graphs under ros fits"),
    ],
)
def test_a_rule_that_fits_no_graph_or_several_is_refused(place: Path, more: str, complaint: str) -> None:
    reported = refusal(place, f"{THREE}import:\n{rules(f'name: /a{more}')}")
    assert reported == f"proxy.yaml:7:5: import[0]: {complaint}"


def test_one_name_may_be_used_in_two_graphs_if_it_is_two_names_elsewhere(place: Path) -> None:
    texts = ["name: /a, ros: 1, metadata: {by: one}", "name: /a, domain: 7, metadata: {by: two}"]
    assert len(proxy(place, f"{THREE}expose:\n{rules(*texts)}").expose) == 2


def test_every_error_of_a_file_is_reported_in_its_order(place: Path) -> None:
    reported = refusals(place, f"{THREE}expose:\n{rules('name: /a', 'name: /b, domain: 3')}record: {{path: x.mcap}}\n")
    assert [line.split(":")[1] for line in reported] == ["7", "8", "9"]


def test_a_topic_is_kept_by_one_holder_or_several(place: Path) -> None:
    (place / "state").mkdir()
    for to, expected in (("store", ("store",)), ("[store-a, store-b]", ("store-a", "store-b"))):
        text = f"{THREE}state: state\nexpose:\n{rules(f'name: /a, ros: 1, keep: {{to: {to}}}')}"
        (rule,) = proxy(place, text).expose
        assert rule.keep is not None
        assert rule.keep.to == expected
    assert "keep.to" in refusal(place, text.replace("[store-a, store-b]", "[]"))


@pytest.mark.parametrize("key", ["disk: 2MB", "before: 5s", "after: 5s", "to: [other]"])
def test_rules_of_one_capsule_agree_and_an_error_names_both(place: Path, key: str) -> None:
    (place / "state").mkdir()
    first, name = "{to: store, capsule: drive}", key.partition(":")[0]
    second = f"{{{key}, capsule: drive}}" if name == "to" else f"{{to: store, {key}, capsule: drive}}"
    texts = [f"name: /a, ros: 1, keep: {first}", f"name: /b, ros: 1, keep: {first}"]
    good = f"{THREE}state: state\nexpose:\n{rules(*texts)}"
    assert [rule.keep.capsule for rule in proxy(place, good).expose if rule.keep] == ["drive", "drive"]
    said = refusal(place, f"{THREE}state: state\nexpose:\n{rules(texts[0], f'name: /b, ros: 1, keep: {second}')}")
    assert f"keep.{name}" in said
    assert "expose[0] states another one for the same capsule" in said
    proxy(place, good.replace("capsule: drive}", "capsule: one}", 1).replace(first, second, 1))
    assert "keep.capsule" in refusal(place, good.replace("drive", "A/B", 1))


@pytest.mark.parametrize("event", ["/dock", "/drive/goal", "/drive/result", "/a"])
def test_windows_may_stand_around_calls_of_what_is_exposed(place: Path, event: str) -> None:
    (place / "state").mkdir()
    named = [
        f"name: /a, type: std_msgs/msg/Bool, keep: {{to: store, when: {event}}}",
        "kind: service, name: /dock, type: std_srvs/srv/Trigger",
        "kind: action, name: /drive, type: nav2_msgs/action/NavigateToPose",
    ]
    text = f"ros: {{endpoint: ros2, domain: 0}}\nstate: state\nexpose:\n{rules(*named)}"
    assert proxy(place, text).expose[0].keep is not None
    for other in ("/other", "/drive", "/drive/cancel", "/dock/goal"):
        complaint = f"keep.when: {other}: no rule of this file names such a topic or call"
        assert complaint in refusal(place, text.replace(f"when: {event}}}", f"when: {other}}}"))
    imported = text.replace("  - {kind: service", "import:\n  - {kind: service")
    if event != "/a":
        assert "no rule of this file names such a topic or call" in refusal(place, imported)


@pytest.mark.parametrize(("side", "history"), [("expose", "from-store"), ("import", "10")])
def test_the_past_comes_from_a_store_to_importers_alone(place: Path, side: str, history: str) -> None:
    text = f"ros: {{endpoint: ros2, domain: 0}}\n{side}:\n{rules(f'name: /a, history: {history}')}"
    assert f": {side}[0].history: under import this has a 'store', under expose none" in refusal(place, text)
    other = {"expose": "10", "import": "{store: holders, age_s: 60}"}[side]
    config = proxy(place, text.replace(history, other))
    assert len([*config.expose, *config.imports]) == 1


@pytest.mark.parametrize(
    ("side", "keys", "complaint"),
    [
        ("expose", "replication: {mode: some}", "replication: this stands in rules under import"),
        ("import", "at_once: 1", "at_once: this stands in rules under expose"),
        ("import", "signers: 2", "signers: this stands in rules under expose"),
        ("expose", "state: ordered, signers: 2", "signers: with 'state: ordered' each request counts alone"),
        ("import", "stop: /halt", "stop: this stands in rules under expose"),
        ("import", "state: ordered, state_node: /node", "state_node: this stands in rules under expose"),
        ("expose", "state_node: /node", "state_node: this needs 'state: ordered'"),
        ("expose", "stop: /halt", "stop: this needs 'at_once: 1'"),
        ("expose", "stop: /halt, at_once: 2", "stop: this needs 'at_once: 1'"),
        ("expose", "stop: /halt, state: ordered", "stop: with 'state: ordered' nothing is broken off"),
        ("expose", "state: ordered, at_once: 2", "at_once: with 'state: ordered' it is always 1"),
    ],
)
def test_a_key_of_the_other_side_is_refused(place: Path, side: str, keys: str, complaint: str) -> None:
    text = f"ros: {{endpoint: ros2, domain: 0}}\n{side}:\n{rules(f'name: /a, kind: service, {keys}')}"
    assert f": {side}[0].{complaint}" in refusal(place, text)
