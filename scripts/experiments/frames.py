"""Tasks with a grey frame: what a robot asks, what a server answers, and whether the answer is right.

Sans-I/O, but the server of ``count`` waits. Each task has both halves: ``FRAME_TASKS`` names them. The frames are drawn
once, when a client makes a task; the network is loaded when a server does.

The installed packages have no service that takes an image, so ``rcl_interfaces/srv/SetParameters`` carries it. The
request has one parameter, named by the frame's number. Its integer array holds the 640 x 480 bytes of the frame, eight
to an integer. The answer's ``reason`` is JSON; a mask in it is text.
"""

from __future__ import annotations

import array
import base64
import itertools
import json
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import SetParameters
from vision import SHAPE, Grey, Mask, Network, Scene, count_words

Said: TypeAlias = "Mapping[str, Any]"  # content of an answer
See: TypeAlias = "Callable[[Grey], Said]"

TYPE: Final = "rcl_interfaces/srv/SetParameters"
_FRAMES: Final = 24  # and then the first one again
_APART_M: Final = 0.005
_TURNED_RAD: Final = 0.03


def request_of(frame: Grey, number: int) -> SetParameters.Request:
    """Return the request that carries a frame."""
    words = array.array("q", frame.tobytes())
    value = ParameterValue(type=ParameterType.PARAMETER_INTEGER_ARRAY, integer_array_value=words)
    return SetParameters.Request(parameters=[Parameter(name=str(number), value=value)])


def frame_of(request: SetParameters.Request) -> Grey:
    """Return the frame that a request carries."""
    words = np.asarray(request.parameters[0].value.integer_array_value, dtype=np.int64)
    return words.view(np.uint8).reshape(SHAPE)


def answer_of(said: Said) -> SetParameters.Response:
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


@dataclass(frozen=True, slots=True)
class FrameTask:
    """Both halves of a task.

    ``draw``: frames, each with what it shows. ``judge``: whether an answer is right, and the note of a sample.
    ``see_with``: settings of a server -> what it answers to a frame.
    """

    draw: Callable[[], Sequence[tuple[Grey, Any]]]
    judge: Callable[[Said, Any], tuple[bool, float]]
    see_with: Callable[[Said], See]


def _of_scenes(is_right: Callable[[Said, Scene], bool], see_with: Callable[[Said], See]) -> FrameTask:
    """Return a task of scenes with words; its note is the number of words."""
    return FrameTask(
        lambda: [(scene.frame, scene) for scene in map(Scene.draw, range(_FRAMES))],
        lambda said, scene: (is_right(said, scene), len(scene.words)),
        see_with,
    )


def _segment(_: Said) -> See:
    network = Network()
    return lambda frame: {"mask": text_of(network.segment(frame))}


def _count(settings: Said) -> See:
    """Count words without a network, and wait for the rest of the request's time, as if another processor worked."""
    takes_s = itertools.cycle(settings["takes_s"])

    def see(frame: Grey) -> Said:
        done_s = time.monotonic() + next(takes_s)
        words = count_words(frame)
        time.sleep(max(done_s - time.monotonic(), 0))
        return {"words": words}

    return see


def _draw_tags() -> list[tuple[Grey, Any]]:
    from tag import Pose, TagCamera

    camera = TagCamera()
    return [(camera.draw(pose), pose) for pose in (Pose.on_its_way(3 * number) for number in range(_FRAMES))]


def _judge_pose(said: Said, truth: Any) -> tuple[bool, float]:
    """Return whether the pose is within 5 mm and 0.03 rad of the drawn one, and the metres apart."""
    if "turn" not in said:
        return False, 0.0
    found = type(truth)(tuple(said["turn"]), tuple(said["at"]))
    apart_m = found.apart_m(truth)
    return apart_m <= _APART_M and found.turned_rad(truth) <= _TURNED_RAD, apart_m


def _find_tag(_: Said) -> See:
    from tag import TagCamera

    camera = TagCamera()

    def see(frame: Grey) -> Said:
        pose = camera.find(frame)
        return {} if pose is None else {"turn": pose.turn, "at": pose.at}

    return see


FRAME_TASKS: Final[Mapping[str, FrameTask]] = {
    "segment": _of_scenes(lambda said, scene: scene.is_covered(mask_in(said["mask"])), _segment),
    "count": _of_scenes(lambda said, scene: said["words"] == len(scene.words), _count),
    "tag": FrameTask(_draw_tags, _judge_pose, _find_tag),
}
