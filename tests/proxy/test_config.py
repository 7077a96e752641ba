"""proxy.yaml as people write it."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.crypto.keys import SigningKey
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.metadata import Metadata
from gdp.nodes.yaml_source import ConfigFileError
from proxy.config import ProxyConfig

OWNER = SigningKey.generate()
NODE = """\
identity: id
domain: {root: root.crt}
iface: robot
delegations: id
"""
RULE = "  - {name: /camera/image, type: sensor_msgs/msg/Image, metadata: {author: lab}, owner: owner.pub}\n"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "id").mkdir()
    (tmp_path / "root.crt").write_text("a certificate")
    (tmp_path / "owner.pub").write_bytes(OWNER.public.to_pem())
    return tmp_path


def proxy(place: Path, text: str) -> ProxyConfig:
    (place / "proxy.yaml").write_text(NODE + text)
    return ProxyConfig.load(place / "proxy.yaml")


def refusal(place: Path, text: str) -> str:
    with pytest.raises(ConfigFileError) as caught:
        proxy(place, text)
    (line,) = str(caught.value).splitlines()
    return line.removeprefix(f"{place}/")


def test_a_rule_needs_only_what_names_the_topic(place: Path) -> None:
    (rule,) = proxy(place, "expose:\n" + RULE).expose
    assert (rule.encoding, rule.reliable, rule.latched, rule.is_global) == ("json", True, False, True)
    assert rule.max_bytes == MESSAGE_MAX_BYTES


def test_the_overlay_name_follows_from_metadata_and_owner(place: Path) -> None:
    (rule,) = proxy(place, "import:\n" + RULE).imports
    metadata = {"kind": "topic", "name": "/camera/image", "type": "sensor_msgs/msg/Image", "author": "lab"}
    assert rule.overlay_name == Metadata(metadata).name(OWNER.public.compressed)


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
        "record: there is nothing to record without a rule under import"
    )


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("sensor_msgs/msg/Image", "Image"), "33: type: expected a type as ROS 2 writes it"),
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
def test_a_wrong_rule_is_told_with_its_place(place: Path, change: tuple[str, str], complaint: str) -> None:
    told = refusal(place, "expose:\n" + RULE.replace(*change))
    assert told.removeprefix("proxy.yaml:6:").replace("expose[0].", "").startswith(complaint)


def test_two_rules_of_one_name_are_refused(place: Path) -> None:
    assert "expose: two rules give the same name: /camera/image" in refusal(place, f"expose:\n{RULE}{RULE}")


def test_a_private_key_is_not_an_owner(place: Path) -> None:
    (place / "owner.pub").write_bytes(OWNER.to_pem())
    assert "expected an owner's public key file" in refusal(place, "expose:\n" + RULE)
