#!/usr/bin/env python3
"""Generator of the demonstration recording: a small robot drives a circle indoors.

The same arguments give the same bytes.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gdp.errors import LocalError
from proxy.recordings.writer import BagWriter
from proxy.serial.channel import Channel, Qos, RosVersion

START_NS: Final = 1_700_000_000_000_000_000
WIDTH, HEIGHT = 640, 480
TEXTURE: Final = 1024  # pixels a side; repeats
HALL_M: Final = (8.0, 6.0)
RADIUS_M, SPEED_M_S = 1.5, 0.6
BEAMS: Final = 720
RANGE_M: Final = (0.12, 6.5)
MAP_CELL_M: Final = 0.05
Fields = Mapping[str, Any]

IMAGES: Final = "/camera/image"
TYPES: Final = {  # topic: type, messages a second (0: one, latched), method of ``Drive``
    "/tf_static": ("tf2_msgs/msg/TFMessage", 0, "static_transforms"),
    "/map": ("nav_msgs/msg/OccupancyGrid", 0, "map"),
    IMAGES: ("sensor_msgs/msg/Image", 10, "image"),
    "/scan": ("sensor_msgs/msg/LaserScan", 10, "scan"),
    "/imu": ("sensor_msgs/msg/Imu", 100, "imu"),
    "/odom": ("nav_msgs/msg/Odometry", 20, "odometry"),
    "/tf": ("tf2_msgs/msg/TFMessage", 20, "transforms"),
}


def scene() -> NDArray[np.uint8]:
    """Return the ground that the camera passes over: uint8 [TEXTURE, TEXTURE, 3], RGB; integers only, so exact."""
    random = np.random.default_rng(7)
    total = np.zeros((TEXTURE, TEXTURE, 3), np.int32)
    for cells, weight in ((8, 4), (32, 2), (128, 1)):
        patch = TEXTURE // cells
        coarse = random.integers(0, 256, (cells, cells, 3), dtype=np.int64).astype(np.int32)
        across = np.arange(TEXTURE, dtype=np.int32) % patch
        y, x = across[:, None, None], across[None, :, None]
        here, below = (each.repeat(patch, 0) for each in (coarse, np.roll(coarse, -1, 0)))
        rows = here * (patch - y) + below * y  # between two rows of cells
        left, right = (each.repeat(patch, 1) for each in (rows, np.roll(rows, -1, 1)))
        smooth: NDArray[Any] = (left * (patch - x) + right * x) // (patch * patch)
        total += weight * smooth
    ground = total // 7
    ticks = np.arange(TEXTURE) % 128 < 3  # tile joints
    ground[ticks] //= 3
    ground[:, ticks] //= 3
    return ground.astype(np.uint8)


class Drive:
    """Robot and its messages, for either ROS."""

    def __init__(self, ros: RosVersion) -> None:
        self.ros = ros
        self.store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        if ros == 1:  # the one type that rosbags does not bring
            transforms = "geometry_msgs/TransformStamped[] transforms\n"
            self.store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
        self.seq = 0

    @cached_property
    def ground(self) -> NDArray[np.uint8]:
        """The scene, twice in each direction."""
        return np.tile(scene(), (2, 2, 1))

    def make(self, type_name: str, given: Fields) -> object:
        """Return a message of a type with these fields; a number that is not given is 0."""
        fields = dict[str, Any]()
        for name, (kind, of) in self.store.fielddefs[type_name][1]:
            value = given.get(name, {} if kind == Nodetype.NAME else 0)
            if kind == Nodetype.NAME:
                value = self.make(str(of), value)
            elif isinstance(value, list):
                value = [self.make(str(of[0][1]), each) for each in value]
            fields[name] = value
        return self.store.types[type_name](**fields)

    def channel(self, topic: str) -> Channel:
        """Return a topic's channel, with definition and hash."""
        type_name, rate, _ = TYPES[topic]
        definition, md5 = self.store.generate_msgdef(type_name, ros_version=self.ros)
        common: dict[str, Any] = {"definition": definition, "definition_format": "msg", "latched": rate == 0}
        if self.ros == 1:
            return Channel(topic, type_name, 1, hash=md5, callerid="/robot", **common)
        durability = "volatile" if rate else "transient_local"
        never = (2_147_483_647, 4_294_967_295)
        qos = Qos(depth=10, reliability="reliable", durability=durability, deadline=never, lifespan=never, lease=never)
        return Channel(topic, type_name, 2, hash=self.store.hash_rihs01(type_name), qos=(qos,), **common)

    def raw(self, topic: str, at_ns: int) -> bytes:
        """Return the message of a topic at a moment, in wire form."""
        type_name, _, method = TYPES[topic]
        message = self.make(type_name, getattr(self, method)(at_ns))
        if self.ros == 1:
            return bytes(self.store.serialize_ros1(message, type_name))
        return bytes(self.store.serialize_cdr(message, type_name, little_endian=True))

    def header(self, at_ns: int, frame: str) -> Fields:
        """Return a header; ``at_ns`` counts from the start."""
        seconds, nanoseconds = divmod(START_NS + at_ns, 1_000_000_000)
        self.seq += 1  # ROS 1 alone
        return {"seq": self.seq, "stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}

    def pose_at(self, at_ns: int) -> tuple[float, float, float]:
        """Return x, y in metres and the heading in radians; rounded, so that no library's last digit shows."""
        turned = SPEED_M_S * at_ns / 1e9 / RADIUS_M
        x, y = RADIUS_M * math.sin(turned), -RADIUS_M * math.cos(turned)
        return round(x, 9), round(y, 9), round(turned, 9)

    def quaternion(self, heading: float) -> Fields:
        """Return the rotation about z; ``heading`` in radians."""
        return {"z": round(math.sin(heading / 2), 9), "w": round(math.cos(heading / 2), 9)}

    def transform(
        self, at_ns: int, frames: tuple[str, str], at: tuple[float, float, float], heading: float = 0.0
    ) -> Fields:
        """Return the transform between two frames; metres, ``heading`` in radians."""
        transform = {"translation": dict(zip("xyz", at, strict=True)), "rotation": self.quaternion(heading)}
        return {"header": self.header(at_ns, frames[0]), "child_frame_id": frames[1], "transform": transform}

    def static_transforms(self, at_ns: int) -> Fields:
        """Return the mounts of camera and laser."""
        mounts = {"camera": (0.2, 0.0, 0.3), "laser": (0.1, 0.0, 0.2)}
        return {"transforms": [self.transform(at_ns, ("base_link", each), at) for each, at in mounts.items()]}

    def transforms(self, at_ns: int) -> Fields:
        """Return the pose of the base in the odometry frame."""
        x, y, heading = self.pose_at(at_ns)
        return {"transforms": [self.transform(at_ns, ("odom", "base_link"), (x, y, 0.0), heading)]}

    def map(self, at_ns: int) -> Fields:
        """Return the occupancy grid of the walls."""
        columns, rows = (round(side / MAP_CELL_M) for side in HALL_M)
        cells = np.zeros((rows, columns), np.int8)
        cells[0] = cells[-1] = cells[:, 0] = cells[:, -1] = 100
        cells[rows // 3 : rows // 2, -1] = -1  # the door: unknown
        info = {
            "map_load_time": {"sec": START_NS // 1_000_000_000},
            "resolution": MAP_CELL_M,
            "width": columns,
            "height": rows,
            "origin": {
                "position": {"x": -HALL_M[0] / 2, "y": -HALL_M[1] / 2},
                "orientation": self.quaternion(0.0),
            },
        }
        return {"header": self.header(at_ns, "map"), "info": info, "data": cells.reshape(-1)}

    def image(self, at_ns: int) -> Fields:
        """Return the image of the camera: RGB, ``HEIGHT`` x ``WIDTH`` pixels."""
        x, y, _ = self.pose_at(at_ns)
        left, top = (round(256 * value) % TEXTURE for value in (x, y))
        view = self.ground[top : top + HEIGHT, left : left + WIDTH]
        return {
            "header": self.header(at_ns, "camera"),
            "height": HEIGHT,
            "width": WIDTH,
            "encoding": "rgb8",
            "is_bigendian": 0,
            "step": 3 * WIDTH,
            "data": np.ascontiguousarray(view).reshape(-1),
        }

    def scan(self, at_ns: int) -> Fields:
        """Return the laser scan: ``BEAMS`` ranges in metres."""
        x, y, heading = self.pose_at(at_ns)
        angles = -math.pi + np.arange(BEAMS) * (2 * math.pi / BEAMS)
        ahead, aside = np.cos(angles + heading), np.sin(angles + heading)
        to_x = np.where(ahead > 0, HALL_M[0] / 2 - x, -HALL_M[0] / 2 - x) / np.where(ahead == 0, 1e-9, ahead)
        to_y = np.where(aside > 0, HALL_M[1] / 2 - y, -HALL_M[1] / 2 - y) / np.where(aside == 0, 1e-9, aside)
        ranges = np.round(np.minimum(to_x, to_y), 3).astype(np.float32)
        door = (to_x < to_y) & (ahead > 0) & (np.abs(y + to_x * aside) < 0.5)
        ranges[door] = np.inf  # nothing to see
        ranges[BEAMS // 2 - 2 : BEAMS // 2 + 2] = -np.inf  # too close: the robot's own bumper
        ranges[at_ns // 100_000_000 % BEAMS :: 97] = np.nan  # no return
        intensities = np.where(np.isfinite(ranges), 1000, 0).astype(np.float32)
        return {
            "header": self.header(at_ns, "laser"),
            "angle_min": -math.pi,
            "angle_max": math.pi,
            "angle_increment": 2 * math.pi / BEAMS,
            "time_increment": 0.1 / BEAMS,
            "scan_time": 0.1,
            "range_min": RANGE_M[0],
            "range_max": RANGE_M[1],
            "ranges": ranges,
            "intensities": intensities,
        }

    def imu(self, at_ns: int) -> Fields:
        """Return the reading of the IMU."""
        _, _, heading = self.pose_at(at_ns)
        shake = round(0.05 * math.sin(at_ns / 1e9 * 40), 9)
        unknown = np.zeros(9)
        unknown[0] = -1
        return {
            "header": self.header(at_ns, "base_link"),
            "orientation": self.quaternion(heading),
            "orientation_covariance": np.diag([1e-3] * 3).reshape(-1),
            "angular_velocity": {"z": SPEED_M_S / RADIUS_M},
            "angular_velocity_covariance": unknown,
            "linear_acceleration": {"x": shake, "y": SPEED_M_S**2 / RADIUS_M, "z": 9.81},
            "linear_acceleration_covariance": unknown,
        }

    def odometry(self, at_ns: int) -> Fields:
        """Return pose and speed of the base."""
        x, y, heading = self.pose_at(at_ns)
        spread = np.diag([1e-4] * 6).reshape(-1)
        pose = {"position": {"x": x, "y": y}, "orientation": self.quaternion(heading)}
        twist = {"linear": {"x": SPEED_M_S}, "angular": {"z": SPEED_M_S / RADIUS_M}}
        return {
            "header": self.header(at_ns, "odom"),
            "child_frame_id": "base_link",
            "pose": {"pose": pose, "covariance": spread},
            "twist": {"twist": twist, "covariance": spread},
        }


def moments(seconds: float) -> Iterator[tuple[int, str]]:
    """Yield (nanoseconds from the start, topic) in time order."""
    events = []
    for order, (topic, (_, rate, _)) in enumerate(TYPES.items()):
        period_ns = 1_000_000_000 // rate if rate else 0
        count = math.ceil(seconds * rate) if rate else 1
        events += [(number * period_ns, order, topic) for number in range(count)]
    for at_ns, _, topic in sorted(events):
        yield at_ns, topic


def main() -> int:
    """Write the recording; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: scripts/make_demo_bag.py --seconds 10 -o drive.mcap",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("-o", "--output", type=Path, help="the file to make (demo.mcap, with --ros1 demo.bag)")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the drive (default: %(default)s)")
    parser.add_argument("--ros1", action="store_true", help="a ROS 1 bag instead of ROS 2 MCAP")
    parser.add_argument("--without-images", action="store_true", help="for slow links: nearly all bytes are images")
    arguments = parser.parse_args()
    if not 0 < arguments.seconds <= 3_600:
        parser.error("--seconds: expected more than 0 and at most 3600")
    output = arguments.output or Path("demo.bag" if arguments.ros1 else "demo.mcap")
    drive = Drive(1 if arguments.ros1 else 2)
    try:
        with BagWriter(output, drive.ros) as bag:
            left_out = {IMAGES} if arguments.without_images else set()
            handles = {topic: bag.add(drive.channel(topic)) for topic in TYPES if topic not in left_out}
            for at_ns, topic in moments(arguments.seconds):
                if topic in handles:
                    bag.write(handles[topic], START_NS + at_ns, drive.raw(topic, at_ns))
    except LocalError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
