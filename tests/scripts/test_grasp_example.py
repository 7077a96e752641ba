"""Messages of the package ``grasp``: a frame and a grasp arrive as they were, and a wrong request is refused."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra ros2")
pytest.importorskip("cv2", reason="needs the extra experiments")
pytest.importorskip("scipy", reason="needs the extra experiments")

from grasp.frames import Frame, is_right, read_frames
from grasp.messages import frame_of, grasp_in, refusal, request_of, response_of
from grasp.sampler import Grasp, plan_grasp
from rcl_interfaces.srv import SetParameters

from tests.pages import ROOT

_FRAME = Frame(np.arange(15, dtype=np.float32).reshape(3, 5), np.ones((3, 5), np.uint8), 518.0)
_GRASP = Grasp(1.0, 2.0, 0.5, 3.0, 0.4, 0.9)


def test_a_frame_arrives_as_it_was_sent() -> None:
    found = frame_of(request_of(_FRAME))
    assert (found.depth == _FRAME.depth).all()
    assert (found.mask == _FRAME.mask).all()
    assert found.focal == _FRAME.focal


@pytest.mark.parametrize("name", ["depth", "mask", "shape", "focal"])
def test_a_request_without_one_of_its_parameters_is_refused(name: str) -> None:
    request = request_of(_FRAME)
    request.parameters = [each for each in request.parameters if each.name != name]
    with pytest.raises(ValueError, match=name):
        frame_of(request)


@pytest.mark.parametrize("shape", [[3], [3, 5, 1], [300, 500], [0, 5], [-1, 5]])
def test_a_request_whose_shape_does_not_fit_its_pixels_is_refused(shape: list[int]) -> None:
    request = request_of(_FRAME)
    (stated,) = (each for each in request.parameters if each.name == "shape")
    stated.value.integer_array_value = shape
    with pytest.raises(ValueError):  # noqa: PT011  (the text is NumPy's for some)
        frame_of(request)


@pytest.mark.parametrize("grasp", [_GRASP, None])
def test_a_grasp_arrives_as_it_was_planned(grasp: Grasp | None) -> None:
    assert grasp_in(response_of(grasp, "m1")) == (grasp, "m1")


@pytest.mark.parametrize("response", [refusal("no parameter depth"), SetParameters.Response()])
def test_a_refusal_and_the_empty_answer_after_a_timeout_are_no_grasp(response: SetParameters.Response) -> None:
    with pytest.raises(ValueError, match=r"depth|in time"):
        grasp_in(response)


def test_every_recorded_frame_has_a_grasp_on_its_object() -> None:
    frames = read_frames(ROOT / "scripts" / "data" / "rgbd")
    for frame in frames:
        grasp = plan_grasp(frame.depth, frame.mask, frame.focal, 1)
        assert grasp is not None
        assert is_right(grasp, frame)
