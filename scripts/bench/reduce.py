"""Bytes that each reduction of a rule saves, and the CPU time of a message that it costs at both ends.

Frames and one recording are in scripts/data. Cases of recordings that are not there are left out, which is reported.

.venv/bin/python scripts/bench/reduce.py
.venv/bin/python scripts/bench/reduce.py --quick --no-save
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from machine import DATA, RefusedError, data_folder
from report import Rounds, Target, progress
from rosbags.typesys import Stores, get_typestore
from skeleton import Options, Outcome, command_line, run_bench

from lab.process import FailedError
from proxy.bridge.core.decoder import MessageDecoder
from proxy.bridge.core.encoder import description_of
from proxy.bridge.core.reduction import encoders_of, expander_of
from proxy.config.reduction import IMAGE, Compress, Region
from proxy.config.rule import Rule
from proxy.recordings.reader import BagReader
from proxy.serial.channel import Channel
from proxy.wire.message import RosMessage

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

PLAIN: Final = "as it is"
MESSAGES: Final = 60  # of a case, the first ones
MAX_BYTES: Final = 24 << 20
LEVELS: Final = (1, 3, 9)
QUALITIES: Final = (1, 10, 30, 50, 70, 80, 90, 95, 100)
FOCAL_PIXELS: Final = 525.0  # of the camera of the recorded depth frames
DEPTH_UNITS: Final = 5_000.0  # to the metre, of those frames
STORE: Final = get_typestore(Stores.ROS2_JAZZY)
CLOUD: Final = "sensor_msgs/msg/PointCloud2"

Settings = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Case:
    """Messages of one topic as ROS wrote them, and the reductions that are tried on them."""

    name: str
    channel: Channel
    messages: Sequence[bytes]
    reductions: Mapping[str, Settings]


def zstd_of(level: int, dictionary: bytes | None = None) -> Settings:
    """Return the keys of a rule that compresses."""
    return {"compress": Compress.model_construct(codec="zstd", level=level, dictionary=dictionary)}


def described(type_name: str) -> Channel:
    """Return the description of a standard type."""
    definition, _ = STORE.generate_msgdef(type_name, ros_version=2)
    return Channel("/a", type_name, 2, definition=definition, definition_format="msg")


def serialised(type_name: str, **fields: Any) -> bytes:
    """Return a message with a header, in CDR."""
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")
    return bytes(STORE.serialize_cdr(types[type_name](header=header, **fields), type_name))


def image(encoding: str, pixels: npt.NDArray[Any]) -> bytes:
    """Return the message of an image, [height, width] or [height, width, channels]."""
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).view(np.uint8).ravel()
    fields = {"height": height, "width": width, "encoding": encoding, "step": data.size // height}
    return serialised(IMAGE, is_bigendian=0, data=data, **fields)


def frames(pattern: str) -> list[npt.NDArray[Any]]:
    """Return recorded frames. Raises ``RefusedError``: the data, or the library to read them, are missing."""
    try:
        from PIL import Image
    except ImportError as error:
        raise RefusedError("Pillow is not installed: pip install 'gdp-ros[images]'") from error
    return [np.asarray(Image.open(path)) for path in sorted(data_folder("rgbd", [pattern]).glob(pattern))]


def recorded(path: Path, topic_type: str) -> tuple[Channel, list[bytes]] | None:
    """Return the first messages of a type; None where the recording is missing, which is reported."""
    if not path.exists():
        progress(f"left out: {topic_type}, for there is no {path}")
        return None
    found: list[bytes] = []
    channel: Channel | None = None
    with BagReader(path) as reader:
        for message in reader.messages():
            each = reader.channels[message.channel]
            if each.type_name == topic_type and (channel is None or each == channel):
                channel = each
                found.append(message.raw)
                if len(found) >= 10 * MESSAGES:
                    break
    return None if channel is None else (channel, found)


def cases(bags: Path) -> list[Case]:
    """Return all cases with their messages."""
    bgr = [each[:, :, 2::-1] for each in frames("color_*.png")]
    grey = [each.mean(axis=-1).astype(np.uint8) for each in bgr]
    depth = [each.astype(np.uint16) for each in frames("depth_*.png")]
    compressed = {f"zstd {level}": zstd_of(level) for level in LEVELS}
    jpegs: dict[str, Settings] = {f"jpeg {each}": {"image": "jpeg", "quality": each} for each in QUALITIES}
    png: dict[str, Settings] = {"png": {"image": "png"}}
    half: dict[str, Settings] = {"region, half of the width": {"region": Region(x=(0, 320))}}
    found = [
        Case(f"image {encoding} 640x480, recorded", described(IMAGE), [image(encoding, each) for each in pixels], tried)
        for encoding, pixels, tried in (
            ("bgr8", bgr, jpegs | png | compressed | half),
            ("mono8", grey, jpegs | png | compressed),
            ("16UC1", depth, png | compressed),
        )
    ]
    found.append(_points(depth))
    for bag, type_name, what in (
        ("tilt_laser.bag", "sensor_msgs/msg/LaserScan", "scan of 1,078 beams"),
        ("ros_numpy_test.bag", "nav_msgs/msg/OccupancyGrid", "map"),
        ("tilt_laser.bag", "sensor_msgs/msg/Imu", ""),
        ("rosbag2_test", "geometry_msgs/msg/PoseStamped", ""),
    ):
        if taken := recorded(bags / bag, type_name):
            channel, messages = taken
            tried: Mapping[str, Settings] = compressed
            if not what:  # short ones: half of them train a dictionary
                half_way = len(messages) // 2
                dictionary: bytes = zstd.train_dict(messages[:half_way], 4_096).dict_content
                tried = {"zstd 3": zstd_of(3), "zstd 3, dictionary of 4 KiB": zstd_of(3, dictionary)}
                messages = messages[half_way:]
            found.append(Case(f"{what or type_name}, recorded", channel, messages, tried))
    return found


def cloud(points: npt.NDArray[np.float32]) -> bytes:
    """Return the message of a point cloud, float32 [points, 4]: x, y, z, intensity."""
    count, field = len(points), STORE.types["sensor_msgs/msg/PointField"]
    named = [field(name=name, offset=4 * at, datatype=7, count=1) for at, name in enumerate(("x", "y", "z", "i"))]
    data = np.ascontiguousarray(points, np.float32).view(np.uint8).ravel()
    sizes = {"height": 1, "width": count, "point_step": 16, "row_step": 16 * count}
    return serialised(CLOUD, fields=named, is_bigendian=False, data=data, is_dense=True, **sizes)


def _points(depths: Sequence[npt.NDArray[np.uint16]]) -> Case:
    """Return clouds of every second row and column of depth frames, in metres."""
    messages = list[bytes]()
    for depth in depths:
        rows, columns = np.mgrid[0 : depth.shape[0] : 2, 0 : depth.shape[1] : 2]
        z = depth[::2, ::2] / DEPTH_UNITS
        x, y = (columns - 319.5) * z / FOCAL_PIXELS, (rows - 239.5) * z / FOCAL_PIXELS
        points = np.stack([x, y, z, rows + columns], -1).reshape(-1, 4)
        messages.append(cloud(points[points[:, 2] > 0].astype(np.float32)))
    thinned: dict[str, Settings] = {f"voxel_m {edge:g}": {"voxel_m": edge} for edge in (0.02, 0.05, 0.1)}
    both: dict[str, Settings] = {"voxel_m 0.05, zstd 3": {"voxel_m": 0.05, **zstd_of(3)}}
    half: dict[str, Settings] = {"region, half of the width": {"region": Region(x=(0, 100))}}
    tried = thinned | half | {f"zstd {level}": zstd_of(level) for level in LEVELS} | both
    return Case("point cloud of depth 320x240, recorded", described(CLOUD), messages, tried)


def measure_one(case: Case, settings: Settings, passes: int) -> dict[str, float]:
    """Return median bytes of a message and the median CPU time at each end, in ms.

    Raises ``FailedError``: a message of a lossless reduction changed.
    """
    rule = Rule.model_construct(encoding="cdr", **settings)
    messages = case.messages[:MESSAGES]
    encoder = encoders_of(rule)(case.channel)
    description = description_of(rule, (case.channel,))
    expander = expander_of(description, case.channel, MAX_BYTES)
    decoder = MessageDecoder(case.channel, "cdr", case.channel, None)
    quality = rule.quality
    is_lossless = not {"voxel_m", "region", "quality"} & settings.keys()
    sizes, sending, receiving = list[int](), list[float](), list[float]()
    for _ in range(max(passes * MESSAGES // len(messages), 1)):
        for raw in messages:
            begin = time.thread_time_ns()
            body, steps = encoder.encode(raw, quality)
            wire = RosMessage(0, 0, body, steps).to_wire()
            middle = time.thread_time_ns()
            received = decoder.decode(*expander.expand(RosMessage.from_wire(wire)))
            end = time.thread_time_ns()
            sizes.append(len(wire))
            sending.append((middle - begin) / 1e6)
            receiving.append((end - middle) / 1e6)
            if is_lossless and received != raw:
                raise FailedError(f"{case.name}: a message changed")
    return {
        "bytes": statistics.median(sizes),
        "sending, ms": statistics.median(sending),
        "receiving, ms": statistics.median(receiving),
    }


def measure(options: Options) -> Outcome:
    """Measure every reduction on every case, round by round."""
    over = Rounds()
    every = cases(DATA / "bags")
    for _ in range(options.rounds):
        for case in every:
            for name, settings in {PLAIN: {}, **case.reductions}.items():
                for column, value in measure_one(case, settings, options.passes).items():
                    over.add(name, case.name, column, value)
    targets: list[Target] = []
    for case in every:
        for name in case.reductions:
            what = f"{case.name}: {name} / {PLAIN}, bytes"
            targets.append(over.ratio(what, name, PLAIN, case.name, "bytes", None))
    settings = {"messages of a figure": options.passes * MESSAGES or "each once"}
    title = "Bytes and CPU time of reduced messages"
    return Outcome("reduce", title, over, targets, settings)


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=3, quick={"rounds": 1, "passes": 0}, has_record=True)
    parser.set_defaults(passes=2)  # messages of a figure, in 60; 0: each once
    run_bench(parser, measure)
