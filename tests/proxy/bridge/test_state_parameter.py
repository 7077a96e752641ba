"""Parameter ``state``, as rclpy writes and reads it."""

from __future__ import annotations

import pytest

from proxy.bridge.state_parameter import read_request, state_in, was_set, write_request

serialization = pytest.importorskip("rclpy.serialization", reason="rclpy is not installed")


@pytest.mark.filterwarnings("ignore:module .sre:DeprecationWarning")
def test_a_state_is_read_and_written_as_rclpy_does() -> None:
    from rcl_interfaces.srv import GetParameters, SetParameters

    for state in (b"", b"abc", bytes(range(256)) * 50):
        asked = serialization.deserialize_message(write_request(state), SetParameters.Request)
        (parameter,) = asked.parameters
        assert (parameter.name, parameter.value.type) == ("state", 5)
        assert b"".join(parameter.value.byte_array_value) == state
        said = GetParameters.Response(values=[parameter.value])
        assert state_in(bytes(serialization.serialize_message(said))) == state
    assert serialization.deserialize_message(read_request(), GetParameters.Request).names == ["state"]


@pytest.mark.filterwarnings("ignore:module .sre:DeprecationWarning")
def test_a_node_that_has_no_such_parameter_or_refuses_it_is_understood() -> None:
    from rcl_interfaces.msg import ParameterValue, SetParametersResult
    from rcl_interfaces.srv import GetParameters, SetParameters

    for values in ([], [ParameterValue()], [ParameterValue(type=4, string_value="x")]):
        assert state_in(bytes(serialization.serialize_message(GetParameters.Response(values=values)))) is None
    for result, why_not in (
        (SetParametersResult(successful=True), ""),
        (SetParametersResult(successful=False, reason="too old"), "too old"),
    ):
        said = SetParameters.Response(results=[result])
        assert was_set(bytes(serialization.serialize_message(said))) == why_not
    assert (state_in(b"\0\1"), was_set(b"")) == (None, "its answer cannot be read")
