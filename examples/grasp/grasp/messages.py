"""Service messages that carry a frame and its grasp, in a service type that every ROS 2 has.

Sans-I/O.

No package of ROS 2 itself has a service that takes an image, so ``rcl_interfaces/srv/SetParameters`` carries it.
The request has the parameters ``depth`` and ``mask``, whose integer arrays hold eight bytes an integer, ``shape``
(height, width) and ``focal``. The ``reason`` of the response is JSON: the grasp, and the machine that planned it.
"""

from __future__ import annotations

import array
import json
from dataclasses import asdict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import SetParameters

from grasp.frames import Frame
from grasp.sampler import Grasp

__all__ = ["SERVICE", "frame_of", "grasp_in", "refusal", "request_of", "response_of"]

SERVICE: Final = "/grasp"
_WORD_BYTES: Final = 8


def request_of(frame: Frame) -> SetParameters.Request:
    """Return the request that carries a frame."""
    parameters = [
        Parameter(name="depth", value=_integers(_packed(frame.depth))),
        Parameter(name="mask", value=_integers(_packed(frame.mask))),
        Parameter(name="shape", value=_integers(array.array("q", frame.depth.shape))),
        Parameter(
            name="focal", value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=float(frame.focal))
        ),
    ]
    return SetParameters.Request(parameters=parameters)


def frame_of(request: SetParameters.Request) -> Frame:
    """Return the frame that a request carries.

    Raises:
        ValueError: a parameter is missing, or its size is wrong.
    """
    values = {each.name: each.value for each in request.parameters}
    if missing := {"depth", "mask", "shape", "focal"} - values.keys():
        raise ValueError(f"no parameter {', '.join(sorted(missing))}")
    height, width = values["shape"].integer_array_value
    if min(height, width) < 1 or not values["focal"].double_value > 0:
        raise ValueError("shape and focal must be positive")
    depth, mask = (
        _unpacked(values[name].integer_array_value, kind, (height, width))
        for name, kind in (("depth", np.dtype(np.float32)), ("mask", np.dtype(np.uint8)))
    )
    return Frame(depth, mask, values["focal"].double_value)


def response_of(grasp: Grasp | None, machine: str) -> SetParameters.Response:
    """Return the response with a grasp; None: there is none."""
    said = {"grasp": asdict(grasp) if grasp else None, "machine": machine}
    return SetParameters.Response(results=[SetParametersResult(successful=True, reason=json.dumps(said))])


def refusal(reason: str) -> SetParameters.Response:
    """Return the response to a request that carries no frame."""
    return SetParameters.Response(results=[SetParametersResult(successful=False, reason=reason)])


def grasp_in(response: SetParameters.Response) -> tuple[Grasp | None, str]:
    """Return the grasp of a response, and the machine that planned it.

    Raises:
        ValueError: the planner refused; the text is its reason.
    """
    if not response.results:
        raise ValueError("no replica answered in time")  # a proxy answers empty then
    (result,) = response.results
    if not result.successful:
        raise ValueError(result.reason)
    said = json.loads(result.reason)
    return Grasp(**said["grasp"]) if said["grasp"] else None, said["machine"]


def _integers(words: array.array[int]) -> ParameterValue:
    return ParameterValue(type=ParameterType.PARAMETER_INTEGER_ARRAY, integer_array_value=words)


def _packed(pixels: NDArray[Any]) -> array.array[int]:
    raw = pixels.tobytes()
    return array.array("q", raw + bytes(-len(raw) % _WORD_BYTES))


def _unpacked(words: array.array[int], kind: np.dtype[Any], shape: tuple[int, int]) -> NDArray[Any]:
    """Return pixels. Raises ``ValueError``: there are too few words."""
    raw = np.asarray(words, dtype=np.int64).tobytes()
    return np.frombuffer(raw, dtype=kind, count=shape[0] * shape[1]).reshape(shape)
