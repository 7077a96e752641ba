"""Discovery range of ROS 2 as Cyclone DDS gets it."""

from __future__ import annotations

import pytest

from gdp.errors import LocalError
from gdp_extensions.dds.node import with_discovery_range

_RANGE, _ONLY = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY"


@pytest.mark.parametrize(
    "environment",
    [{_RANGE: "LOCALHOST"}, {_RANGE: "localhost"}, {_ONLY: "1"}, {_RANGE: "LOCALHOST", _ONLY: "0"}],
)
def test_a_graph_of_this_host_has_no_multicast_and_this_host_as_its_peer(environment: dict[str, str]) -> None:
    uri = with_discovery_range(environment)
    assert uri is not None
    assert "<AllowMulticast>false<" in uri
    assert '<Peer address="localhost"/>' in uri


@pytest.mark.parametrize("environment", [{}, {_RANGE: "SUBNET"}, {_RANGE: "SUBNET", _ONLY: "1"}, {_ONLY: "0"}])
def test_any_other_graph_keeps_what_is_configured(environment: dict[str, str]) -> None:
    assert with_discovery_range({**environment, "CYCLONEDDS_URI": "file:///etc/dds.xml"}) is None


def test_what_the_user_configured_comes_last_and_once() -> None:
    uri = with_discovery_range({_RANGE: "LOCALHOST", "CYCLONEDDS_URI": "file:///etc/dds.xml"})
    assert uri is not None
    assert uri.endswith(",file:///etc/dds.xml")
    assert with_discovery_range({_RANGE: "LOCALHOST", "CYCLONEDDS_URI": uri}) is None


@pytest.mark.parametrize("stated", ["OFF", "PLANET"])
def test_a_range_without_peers_is_refused(stated: str) -> None:
    with pytest.raises(LocalError, match="the endpoint dds knows SUBNET, LOCALHOST"):
        with_discovery_range({_RANGE: stated})
