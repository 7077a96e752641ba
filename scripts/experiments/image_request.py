"""Service messages that carry a grey frame and its result, in a service type that every ROS 2 has.

Sans-I/O.

The installed packages have no service that takes an image, so ``rcl_interfaces/srv/SetParameters`` carries it. The
request has one parameter, named by the frame's number. Its integer array holds the 640 x 480 bytes of the frame, eight
to an integer. The answer's ``reason`` is JSON; a mask in it is text.
"""

from __future__ import annotations

import array
import base64
import json
import zlib
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import SetParameters
from vision import SHAPE, Grey, Mask

TYPE: Final = "rcl_interfaces/srv/SetParameters"


def request_of(frame: Grey, number: int) -> SetParameters.Request:
    """Return the request that carries a frame."""
    words = array.array("q", frame.tobytes())
    value = ParameterValue(type=ParameterType.PARAMETER_INTEGER_ARRAY, integer_array_value=words)
    return SetParameters.Request(parameters=[Parameter(name=str(number), value=value)])


def frame_of(request: SetParameters.Request) -> Grey:
    """Return the frame that a request carries."""
    words = np.asarray(request.parameters[0].value.integer_array_value, dtype=np.int64)
    return words.view(np.uint8).reshape(SHAPE)


def answer_of(said: Mapping[str, object]) -> SetParameters.Response:
    """Return the response with this content."""
    return SetParameters.Response(results=[SetParametersResult(successful=True, reason=json.dumps(said))])


def said_in(response: SetParameters.Response) -> dict[str, Any]:
    """Return the content of a response."""
    said = json.loads(response.results[0].reason)
    return said if isinstance(said, dict) else {}


def text_of(mask: Mask) -> str:
    """Return a mask as text, for an answer."""
    return base64.b64encode(zlib.compress(np.packbits(mask).tobytes())).decode()


def mask_in(text: str) -> Mask:
    """Return the mask that a text of ``text_of`` has."""
    packed = np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype=np.uint8)
    return np.unpackbits(packed).reshape(SHAPE).astype(np.bool_)
