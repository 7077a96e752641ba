"""DDS names and participants of ROS 2; no network."""

from __future__ import annotations

import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("cyclonedds", reason="Cyclone DDS's Python binding is not installed")

from gdp.extras import install_command
from gdp_extensions.dds.graph_cache import GraphCache, Peer
from gdp_extensions.dds.naming import Named, dds_type, hash_in, identity, identity_in, named, user_data
from gdp_extensions.dds.node_info import NodeInfo, read_info, write_info
from proxy.endpoints.core.endpoint import Role
from proxy.endpoints.core.qos import default

ME = bytes(range(16))
READER, WRITER = bytes([1] * 16), bytes([2] * 16)
HASH = "RIHS01_" + "ab" * 32


@pytest.mark.parametrize(
    ("topic", "type_name", "is_writer", "what"),
    [
        ("rt/a/b", "std_msgs/msg/String", True, Named(Role.PUBLISHES, "/a/b", "std_msgs/msg/String")),
        ("rt/a", "std_msgs/msg/String", False, Named(Role.SUBSCRIBES, "/a", "std_msgs/msg/String")),
        ("rq/setRequest", "p/srv/Set_Request", False, Named(Role.SERVES, "/set", "p/srv/Set")),
        ("rq/setRequest", "p/srv/Set_Request", True, Named(Role.CALLS, "/set", "p/srv/Set")),
        (
            "rq/go/_action/send_goalRequest",
            "p/action/Go_SendGoal_Request",
            False,
            Named(Role.SERVES, "/go/_action/send_goal", "p/action/Go_SendGoal"),
        ),
        ("rr/setReply", "p/srv/Set_Response", True, None),
        ("plain", "std_msgs/msg/String", True, None),
    ],
)
def test_a_dds_name_says_what_an_end_is(topic: str, type_name: str, is_writer: bool, what: Named | None) -> None:
    assert named(topic, dds_type(type_name), is_writer=is_writer) == what


def test_a_type_that_is_not_of_ros_is_none_of_ours() -> None:
    assert named("rt/a", "Vehicle::Speed", is_writer=True) is None


def test_user_data_holds_hash_and_identity() -> None:
    data = user_data(HASH, identity("clientid", ME, 3))
    assert (hash_in(data), identity_in(data)) == (HASH, b"0.1.2.3.4.5.6.7.8.9.10.11.0.0.0.3")
    assert (hash_in(b"enclave=/;"), identity_in(b"")) == ("", b"")


@pytest.mark.parametrize("wide", [16, 24])
def test_what_a_node_tells_of_itself_is_read_again(wide: int) -> None:
    raw = write_info(ME, "camera", [READER], [WRITER], wide)
    assert read_info(raw) == NodeInfo(ME, {READER: "/camera", WRITER: "/camera"}, wide)


@given(st.binary(max_size=200))
def test_what_is_no_node_information_is_read_as_none_or_as_some(raw: bytes) -> None:
    found = read_info(raw)
    assert found is None or isinstance(found, NodeInfo)


def test_the_entities_of_a_ros_participant_show_once_it_announced_their_node() -> None:
    survey = GraphCache()
    peer = Peer(WRITER, Named(Role.PUBLISHES, "/a", "std_msgs/msg/String"), "", default(), b"")
    survey.joined(1, WRITER)
    survey.found(2, peer)
    assert not survey.graph()
    survey.receive_node_info(NodeInfo(WRITER, {WRITER: "/camera"}, 16))
    assert [(end.node, end.key) for end in survey.graph()] == [("/camera", WRITER.hex())]
    survey.lost(2)
    assert not survey.graph()


def test_what_is_not_ros_shows_without_a_node() -> None:
    survey = GraphCache()
    survey.found(2, Peer(WRITER, Named(Role.PUBLISHES, "/a", "std_msgs/msg/String"), "", default(), b""))
    assert [end.node for end in survey.graph()] == [""]


def test_without_the_binding_one_sentence_says_what_to_install() -> None:
    code = (
        "import sys; sys.modules['cyclonedds'] = None\n"
        "from gdp.errors import LocalError\n"
        "from proxy.config.graph import RosGraphConfig\n"
        "from proxy.endpoints.live import open_endpoint\n"
        "try:\n    open_endpoint(RosGraphConfig(endpoint='dds'), 'n')\n"
        "except LocalError as error:\n    print(error)\n"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said == f"endpoint dds needs cyclonedds (run: {install_command('dds')})\n"
