"""Images and point clouds as ROS writes them, in either ROS's wire form."""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from proxy.config.reduction import CLOUD, IMAGE
from proxy.serial.channel import Channel, RosVersion

__all__ = ["channel", "cloud", "cloud_of", "image", "image_of", "pixels_of"]

_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


@cache
def store(ros: RosVersion = 2) -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_JAZZY)


@cache
def channel(type_name: str, ros: RosVersion = 2) -> Channel:
    """Return the description of a type."""
    definition, _ = store(ros).generate_msgdef(type_name, ros_version=ros)
    return Channel("/a", type_name, ros, definition=definition, definition_format="msg")


def image(
    encoding: str,
    shape: tuple[int, ...],
    pixels: npt.NDArray[Any],
    *,
    ros: RosVersion = 2,
    pad: int = 0,
    order: int = 0,
) -> bytes:
    """Return a message of an image; ``pad``: bytes after each row."""
    rows = pixels.reshape(shape[0], -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, pad)))
    types = store(ros).types
    message = types[IMAGE](
        header=_header(ros),
        height=shape[0],
        width=shape[1],
        encoding=encoding,
        is_bigendian=order,
        step=rows.shape[1],
        data=rows.ravel(),
    )
    return _written(message, IMAGE, ros)


def image_of(raw: bytes, ros: RosVersion = 2) -> Any:
    """Return the fields of an image."""
    return store(ros).deserialize_ros1(raw, IMAGE) if ros == 1 else store().deserialize_cdr(raw, IMAGE)


def pixels_of(raw: bytes, ros: RosVersion = 2) -> npt.NDArray[np.uint8]:
    """Return the rows of an image, uint8 [height, step]."""
    message = image_of(raw, ros)
    data: npt.NDArray[np.uint8] = message.data
    return data.reshape(message.height, message.step)


def cloud(points: npt.NDArray[np.float32], *, rows: int = 1, ros: RosVersion = 2) -> bytes:
    """Return a message of points, float32 [points, 4]: x, y, z, intensity."""
    types = store(ros).types
    field = types["sensor_msgs/msg/PointField"]
    names = _POINT.names or ()
    width = len(points) // rows
    message = types[CLOUD](
        header=_header(ros),
        height=rows,
        width=width,
        fields=[field(name=name, offset=4 * at, datatype=7, count=1) for at, name in enumerate(names)],
        is_bigendian=False,
        point_step=_POINT.itemsize,
        row_step=width * _POINT.itemsize,
        data=np.ascontiguousarray(points, "<f4").view(np.uint8).ravel(),
        is_dense=False,
    )
    return _written(message, CLOUD, ros)


def cloud_of(raw: bytes, ros: RosVersion = 2) -> tuple[Any, npt.NDArray[np.float32]]:
    """Return the fields of a cloud and its points, float32 [points, 4]."""
    message: Any = store(ros).deserialize_ros1(raw, CLOUD) if ros == 1 else store().deserialize_cdr(raw, CLOUD)
    return message, message.data.view("<f4").reshape(-1, 4)


def _header(ros: RosVersion) -> Any:
    types = store(ros).types
    stamp = types["builtin_interfaces/msg/Time"](sec=7, nanosec=8)
    more = {"seq": 9} if ros == 1 else {}
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id="lens", **more)


def _written(message: Any, type_name: str, ros: RosVersion) -> bytes:
    if ros == 1:
        return bytes(store(1).serialize_ros1(message, type_name))
    return bytes(store().serialize_cdr(message, type_name))
