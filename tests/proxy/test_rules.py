"""Rules, as people write them: accepted ones, refused ones with the position, and their meaning."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from gdp.errors import LocalError
from gdp.metadata import Metadata
from gdp.service.replication import Mode, Replication
from proxy.config.matching import choose, imported
from tests.proxy.rule_files import OTHER, OWNER, furnish, proxy, refusals, rule, rules

IMAGE = "sensor_msgs/msg/Image"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    furnish(tmp_path)
    return tmp_path


GOOD = [
    "name: /chatter",
    "name: /camera/**",
    "name: /a, type: std_msgs/msg/String",
    "name: /a/_service_event, type: std_srvs/srv/SetBool_Event",
    "name: /fold/_action/feedback, type: test_msgs/action/Fibonacci_FeedbackMessage",
    "name: /set, kind: service, type: std_srvs/srv/SetBool",
    "name: /set, kind: service, timeout_s: null",
    "name: /set, kind: service, timeout_s: 0.5, priority: urgent, max_bytes: 100",
    "name: /set, kind: service, stop: /set/stop, at_once: 1",
    "name: /set, kind: service, signers: 2",
    "name: /set, kind: service, state: ordered",
    "name: /set, kind: service, state: ordered, state_node: /counter",
    "name: /fold, kind: action, type: test_msgs/action/Fibonacci, timeout_s: 10",
    "name: /arm/*, kind: node, encoding: cdr, priority: high",
    "name: /a, remap: /b/c",
    "name: /a, max_hz: 10",
    "name: /a, max_hz: 0.1, reliable: null, latched: null",
    "name: /a, reliable: false, deadline_ms: 150, repair: never",
    "name: /a, priority: urgent, fec: never",
    "name: /a, weight: 100, max_bits_s: 4000000",
    "name: /set, kind: service, weight: 5, max_bits_s: 1000",
    "name: /a, ros: 2, domain: 0",
    "name: /a, frames: {add: robot1/, common: [map, earth]}",
    "name: /a, frames: {remove: robot1/}",
    "name: /a, control: exclusive",
    "name: /a, control: {silence_s: null, stop: {linear: {x: 0.0}}}",
    "name: /a, readers: own-pace, reliable: false",
    "name: /a, paths: 2",
    "name: /set, kind: service, paths: 2",
    "name: /set, kind: service, sign: session",
    "name: /spin, kind: action, sign: session",
    "name: /a, metadata: {author: lab, pin: 7}",
    "name: /a, compress: zstd",
    "name: /a, compress: {codec: zstd, level: 9}",
    "name: /a, image: png, adapt: true",
    "name: /a, type: sensor_msgs/msg/Image, image: jpeg, quality: 60, region: {x: [0, 100], y: [10, 20]}",
    "name: /a, type: sensor_msgs/msg/PointCloud2, voxel_m: 0.1, region: {z: [-0.5, 2]}",
    "name: /a, image: jpeg, adapt: {min_hz: 2, max_hz: 10, min_quality: 20, max_quality: 70}",
    "name: /a, adapt: false, compress: null, image: null, voxel_m: null, region: null",
]


@pytest.mark.parametrize("text", GOOD)
def test_a_good_rule_is_taken(place: Path, text: str) -> None:
    assert rule(place, text).name == yaml.safe_load(f"{{{text}}}")["name"]


BAD = [
    ("name: chatter", "name: expected a full ROS name, such as /camera/image, or a pattern"),
    ("name: /a/", "name: expected a full ROS name"),
    ("name: '/a b'", "name: expected a full ROS name"),
    ("name: /a**", "name: expected a full ROS name"),
    (f"name: /{'a' * 512}", "name: expected a full ROS name"),
    ("name: 5", "name: expected a text, not 5"),
    ("name: /a, paths: 3", "paths: expected 1, 2 or 'spread', not 3"),
    ("name: /a, sign: session", "sign: only services and actions have this"),
    ("name: /a, kind: service, sign: never", "sign: expected 'always' or 'session', not 'never'"),
    ("name: /a, kind: param", "kind: expected 'topic', 'service', 'action' or 'node', not 'param'"),
    ("name: /a, kind: node, type: x", "type: expected the type of a node"),
    ("name: /a, kind: node, latched: true", "latched: only topics have this"),
    ("name: /a, type: Image", "type: expected the type of a topic as ROS 2 writes it, such as sensor_msgs/msg/Image"),
    ("name: /a, type: std_srvs/srv/SetBool", "type: expected the type of a topic"),
    ("name: /a, kind: service, type: std_msgs/msg/String", "type: expected the type of a service"),
    ("name: /a, kind: action, type: std_srvs/srv/SetBool", "type: expected the type of an action"),
    ("name: /a, remap: b", "remap: expected a full ROS name"),
    ("name: /a, remap: /*", "remap: expected a full ROS name"),
    ("name: /a/*, remap: /b", "remap: a pattern cannot be remapped; write a rule for each name"),
    ("name: /a, max_hz: 0", "max_hz: expected greater than 0, not 0"),
    ("name: /a, max_hz: fast", "max_hz: expected a number, not 'fast'"),
    ("name: /a, deadline_ms: 0", "deadline_ms: expected greater than 0, not 0"),
    ("name: /a, deadline_ms: 3600001", "deadline_ms: expected less than or equal to 3600000"),
    ("name: /a, repair: always", "repair: expected 'never' or 'in-time', not 'always'"),
    ("name: /a, fec: always", "fec: expected 'auto' or 'never', not 'always'"),
    ("name: /a, weight: 0", "weight: expected greater than or equal to 1, not 0"),
    ("name: /a, weight: 101", "weight: expected less than or equal to 100, not 101"),
    ("name: /a, max_bits_s: 999", "max_bits_s: expected greater than or equal to 1000"),
    ("name: /a, kind: service, deadline_ms: 10", "deadline_ms: only topics have this"),
    ("name: /a, kind: action, repair: never", "repair: only topics have this"),
    ("name: /a, max_bytes: 0", "max_bytes: expected greater than or equal to 1"),
    ("name: /a, timeout_s: 1", "timeout_s: only services and actions have this"),
    ("name: /a, kind: service, timeout_s: 0", "timeout_s: expected greater than 0, not 0"),
    ("name: /a, kind: service, max_hz: 1", "max_hz: only topics have this"),
    ("name: /a, kind: service, reliable: true", "reliable: only topics have this"),
    ("name: /a, kind: action, latched: true", "latched: only topics have this"),
    ("name: /a, replication: {mode: all}", "replication: only services and actions have this"),
    (
        "name: /a, kind: service, replication: {mode: most}",
        "replication.mode: expected 'all', 'some', 'hedged' or 'nearest'",
    ),
    ("name: /a, kind: service, replication: {copies: 0}", "replication.copies: expected greater than or equal to 1"),
    ("name: /a, kind: service, replication: {budget: 2}", "replication.budget: expected less than or equal to 1"),
    ("name: /a, kind: service, stop: halt", "stop: expected a full ROS name, such as /plan/stop"),
    ("name: /a, kind: service, at_once: 0", "at_once: expected greater than or equal to 1"),
    ("name: /a, kind: action, stop: /halt", "stop: only services have this"),
    ("name: /a, kind: action, at_once: 1", "at_once: only services have this"),
    ("name: /a, kind: service, signers: 1", "signers: expected greater than or equal to 2"),
    ("name: /a, kind: action, signers: 2", "signers: only services have this"),
    ("name: /a, kind: action, state: ordered", "state: only services have this"),
    ("name: /a, kind: service, state: kept", "state: expected 'none' or 'ordered'"),
    ("name: /a, kind: service, state: ordered, state_node: node", "state_node: expected a full ROS name"),
    ("name: /a, ros: 3", "ros: expected 1 or 2, not 3"),
    ("name: /a, domain: 233", "domain: expected less than or equal to 232"),
    ("name: /a, compress: {codec: gzip}", "compress.codec: expected 'zstd', not 'gzip'"),
    ("name: /a, compress: {level: 0}", "compress.level: expected greater than or equal to 1"),
    ("name: /a, compress: {dictionary: none}", "compress.dictionary: expected a dictionary of zstd --train"),
    ("name: /a, kind: service, compress: zstd", "compress: only topics have this"),
    ("name: /a, image: gif", "image: expected 'jpeg' or 'png', not 'gif'"),
    ("name: /a, type: std_msgs/msg/String, image: png", "image: only topics of sensor_msgs/msg/Image have this"),
    ("name: /a, image: png, quality: 5", "quality: this needs 'image: jpeg'"),
    ("name: /a, type: sensor_msgs/msg/Image, voxel_m: 1", "voxel_m: only topics of sensor_msgs/msg/PointCloud2"),
    ("name: /a, voxel_m: 0", "voxel_m: expected greater than 0"),
    ("name: /a, region: {x: [2, 1]}", "region.x: expected [low, high] with low below high"),
    ("name: /a, adapt: {min_hz: 5, max_hz: 2}", "adapt: max_hz is below min_hz"),
    ("name: /a, control: shared", "control: expected 'exclusive', not 'shared'"),
    ("name: /a, control: {silence_s: 61}", "control.silence_s: expected less than or equal to 60, not 61"),
    ("name: /a, control: {stop: 0}", "control.stop: expected a mapping"),
    ("name: /a, kind: service, control: exclusive", "control: only topics have this"),
    ("name: /a, frames: {common: [map]}", "frames: expected either add or remove"),
    ("name: /a, metadata: {name: /b}", "metadata: name: state it as a key of the rule itself"),
    ("name: /a, direction: out", "direction: unknown key; expected one of kind, name, type, remap"),
]


@pytest.mark.parametrize(("text", "complaint"), BAD)
def test_a_bad_rule_is_refused_at_the_key_that_is_wrong(place: Path, text: str, complaint: str) -> None:
    (line,) = refusals(place, "ros: {endpoint: ros2, domain: 0}\nexpose:\n" + rules(text))
    where, _, rest = line.partition(": expose[0].")
    assert rest.startswith(complaint)
    key = complaint.partition(":")[0].rpartition(".")[2]
    shown = key if "unknown key" in complaint else f"{key}: "  # a wrong value is shown where it begins
    begins = text.index(key) if shown == key else text.rindex(shown) + len(shown)
    assert where == f"proxy.yaml:7:{begins + len('  - {') + 1}"


CLASHES = [
    ("expose", ["name: /a", "name: /a"], "expose[1].name: expose[0] gives the same name: /a"),
    ("expose", ["name: /a", "name: /a, type: std_msgs/msg/String"], "expose[1].name: expose[0] gives the same name"),
    ("expose", ["name: /a", "name: /a, remap: /b"], "expose[1].name: expose[0] gives the same name"),
    ("expose", ["name: /a", "name: /b, remap: /a"], "expose[1].name: expose[0] is about /a of this machine, too"),
    ("expose", ["name: /a", "name: /a, owner: other.pub"], "expose[1].name: expose[0] is about /a of this machine"),
    ("expose", ["name: /*", "name: /*, owner: other.pub"], "expose[1].name: expose[0] is about /* of this machine"),
    ("import", ["name: /a", "name: /a, metadata: {by: x}"], "import[1].name: import[0] is about /a of this machine"),
    ("import", ["name: /a, prefix: r", "name: /b, prefix: r, remap: /a"], "import[1].name: import[0] is about /a of"),
    ("import", ["name: /*", "name: /*"], "import[1].name: import[0] gives the same name: /*"),
]


@pytest.mark.parametrize(("side", "texts", "complaint"), CLASHES)
def test_two_rules_about_one_thing_are_refused(place: Path, side: str, texts: list[str], complaint: str) -> None:
    (line,) = refusals(place, f"{side}:\n{rules(*texts)}")
    assert line.startswith(f"proxy.yaml:7:12: {complaint}")


@pytest.mark.parametrize(
    ("side", "texts"),
    [
        ("expose", ["name: /a", "name: /*", "name: /**"]),
        ("expose", ["name: /a, type: std_msgs/msg/String", "name: /a, type: std_msgs/msg/Int8"]),  # a recording may
        ("expose", ["name: /a", "name: /a, kind: service", "name: /a, kind: action"]),
        ("import", ["name: /*", "name: /*, owner: other.pub"]),
        ("import", ["name: /tf, prefix: robot1", "name: /tf, prefix: robot2", "name: /tf"]),
        ("import", ["name: /a", "name: /a, metadata: {by: x}, remap: /b"]),
    ],
)
def test_rules_about_different_things_stand_together(place: Path, side: str, texts: list[str]) -> None:
    config = proxy(place, f"ros: {{endpoint: ros2, domain: 0}}\n{side}:\n{rules(*texts)}")
    assert len(config.expose if side == "expose" else config.imports) == len(texts)


@pytest.mark.parametrize("kind", ["service", "action"])
def test_a_service_is_not_both_exposed_and_imported_but_a_topic_may_be(place: Path, kind: str) -> None:
    def both(of: str) -> str:
        one = rules(f"name: /a, kind: {of}")
        return f"ros: {{endpoint: ros2, domain: 0}}\nexpose:\n{one}import:\n{one}"

    (line,) = refusals(place, both(kind))
    assert line.startswith("proxy.yaml:9:12: import[0].name: expose[0] gives the same name: /a; one machine serves a")
    config = proxy(place, both("topic"))
    assert [each.name for each in (*config.expose, *config.imports)] == ["/a", "/a"]


def test_what_a_rule_leaves_open_follows_the_source(place: Path) -> None:
    free = rule(place, "name: /a")
    assert (free.wants_reliable, free.wants_latched, free.reliable, free.latched) == (None, None, True, False)
    set_ = rule(place, "name: /a, reliable: false, latched: true")
    assert (set_.wants_reliable, set_.wants_latched, set_.reliable, set_.latched) == (False, True, False, True)


def test_a_rule_says_how_requests_are_spread(place: Path) -> None:
    spreads = ["service", "service, replication: {mode: some}", "action, replication: {mode: hedged, budget: 0.1}"]
    texts = [f"name: /a, kind: {spread}" for spread in spreads]
    given = [proxy(place, f"ros: {{endpoint: ros2}}\nimport:\n{rules(text)}").imports[0].spread for text in texts]
    assert given == [
        Replication(copies=2),
        Replication(Mode.SOME, copies=2),
        Replication(Mode.HEDGED, copies=2, budget=0.1),
    ]


def test_a_remapped_rule_knows_both_names(place: Path) -> None:
    given = rule(place, f"name: /camera/image, type: {IMAGE}, remap: /usb_cam/image_raw, metadata: {{author: lab}}")
    assert given.matches("/usb_cam/image_raw")
    assert not given.matches("/camera/image")
    metadata = Metadata({"kind": "topic", "name": "/camera/image", "type": IMAGE, "author": "lab"})
    assert given.overlay_metadata == given.metadata_of("/usb_cam/image_raw", IMAGE) == metadata
    assert given.overlay_name == given.overlay_name_of("/usb_cam/image_raw", IMAGE) == metadata.name(_key())
    assert given.local_of(metadata) == "/usb_cam/image_raw"


def test_a_pattern_gives_each_name_its_own(place: Path) -> None:
    given = rule(place, "name: /camera/**, metadata: {author: lab}")
    assert given.metadata_of("/camera/left/image", IMAGE)["name"] == "/camera/left/image"
    assert given.local_of(given.metadata_of("/camera/left/image", IMAGE)) == "/camera/left/image"


@pytest.mark.parametrize("text", ["name: /camera/*, type: sensor_msgs/msg/Image", "name: /camera/image"])
def test_what_depends_on_what_is_found_has_no_overlay_name(place: Path, text: str) -> None:
    with pytest.raises(LocalError, match="has no name of its own"):
        _ = rule(place, text).overlay_name


@pytest.mark.parametrize(
    "change",
    [{"kind": "service"}, {"name": "/other/image"}, {"type": "sensor_msgs/msg/Imu"}, {"author": "they"}, {"more": 1}],
)
@pytest.mark.parametrize("name", ["/camera/*", "/camera/image"])
def test_metadata_of_something_else_do_not_fit(place: Path, name: str, change: dict[str, str | int]) -> None:
    given = rule(place, f"name: {name}, type: {IMAGE}, metadata: {{author: lab}}")
    right: dict[str, str | int] = {"kind": "topic", "name": "/camera/image", "type": IMAGE, "author": "lab"}
    assert given.local_of(Metadata(right)) == "/camera/image"
    assert given.local_of(Metadata({**right, **change})) is None


def test_metadata_without_a_name_or_a_type_fit_nothing(place: Path) -> None:
    given = rule(place, "name: /**")
    assert given.local_of(Metadata({"kind": "topic", "name": "/a"})) is None
    assert given.local_of(Metadata({"kind": "topic", "type": IMAGE})) is None
    assert given.local_of(Metadata({"kind": "topic", "name": "/a", "type": "std_srvs/srv/SetBool"})) is None


def test_a_full_name_comes_before_a_pattern_and_the_first_pattern_before_the_next(place: Path) -> None:
    texts = ["name: /**", "name: /camera/*", "name: /camera/image", "name: /camera/*, kind: service"]
    given = proxy(place, f"ros: {{endpoint: ros2, domain: 0}}\nexpose:\n{rules(*texts)}").expose
    assert choose(given, "topic", "/camera/image") is given[2]
    assert choose(given, "topic", "/camera/info") is given[0]
    assert choose(given, "service", "/camera/info") is given[3]
    assert choose(given, "service", "/info") is None


def test_a_full_name_of_another_type_is_not_taken_by_a_pattern(place: Path) -> None:
    given = proxy(place, f"expose:\n{rules('name: /**', f'name: /image, type: {IMAGE}')}").expose
    assert choose(given, "topic", "/image", IMAGE) is given[1]
    assert choose(given, "topic", "/image") is given[1]
    assert choose(given, "topic", "/image", "std_msgs/msg/String") is None


def test_a_pattern_with_a_type_takes_only_that(place: Path) -> None:
    given = proxy(place, f"expose:\n{rules(f'name: /*, type: {IMAGE}', 'name: /**')}").expose
    assert choose(given, "topic", "/a", IMAGE) is given[0]
    assert choose(given, "topic", "/a", "std_msgs/msg/String") is given[1]


def test_an_overlay_name_is_imported_by_the_rule_of_its_owner(place: Path) -> None:
    texts = ["name: /*", "name: /*, owner: other.pub", "name: /a, remap: /b"]
    given = proxy(place, f"import:\n{rules(*texts)}").imports
    metadata = {name: Metadata({"kind": "topic", "name": name, "type": IMAGE}) for name in ("/a", "/c", "/d/e")}
    owner, other = OWNER.public.compressed, OTHER.public.compressed
    assert imported(given, metadata["/a"].name(owner), metadata["/a"]) == (given[2], "/b")
    assert imported(given, metadata["/a"].name(other), metadata["/a"]) == (given[1], "/a")
    assert imported(given, metadata["/c"].name(owner), metadata["/c"]) == (given[0], "/c")
    assert imported(given, metadata["/d/e"].name(owner), metadata["/d/e"]) is None
    assert imported(given, metadata["/a"].name(b""), metadata["/a"]) is None


def _key() -> bytes:
    return OWNER.public.compressed
