"""Point clouds of a topic: cut to a region, and thinned to one point in each voxel.

Sans-I/O. Each point that stays is a measured one with all its fields: the first of its voxel. The result is a
``sensor_msgs/PointCloud2`` of one row without points that have no finite position.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from proxy.config.reduction import Bounds, Region
from proxy.serial.channel import Channel
from proxy.serial.reader import Tree
from proxy.serial.serializer import native_codec

_Axes: TypeAlias = "npt.NDArray[np.float64]"
_FORMATS: Final = {7: "f4", 8: "f8"}  # PointField.FLOAT32, FLOAT64
_VOXELS_MAX: Final = 1 << 21  # along each axis: three of them fit into 63 bits


class CloudReducer:
    """Reducer of one channel's point clouds.

    Args:
        voxel_m: edge of a voxel in metres; None: points are not thinned.
        region: in metres, in the cloud's own frame.

    Raises:
        DefinitionError: the channel has no usable definition.
    """

    __slots__ = ("_codec", "_region", "_voxel_m")

    def __init__(self, channel: Channel, voxel_m: float | None, region: Region | None) -> None:
        self._codec = native_codec(channel)
        self._voxel_m = voxel_m
        self._region = region or Region()

    def reduce(self, raw: bytes) -> bytes:
        """Return the message with fewer points; one that cannot be read, or loses no point, is returned unchanged."""
        tree = self._codec.to_tree(raw)
        points = _points_of(tree)
        if points is None or not isinstance(tree, dict) or not len(points):
            return raw
        axes = _axes_of(tree, points)
        if axes is None:
            return raw
        kept = np.flatnonzero(_is_inside(axes, self._region))
        if self._voxel_m is not None and len(kept):
            kept = kept[first_of_voxels(axes[:, kept], self._voxel_m)]
        if len(kept) == len(points):
            return raw
        size = points.shape[1]
        tree |= {"height": 1, "width": len(kept), "row_step": len(kept) * size, "is_dense": 1}
        tree["data"] = memoryview(points[kept].tobytes())
        return self._codec.to_raw(tree)


def first_of_voxels(axes: _Axes, voxel_m: float) -> npt.NDArray[np.intp]:
    """Return the index of the first point in each voxel, in rising order.

    Args:
        axes: float64 [3, points], finite, in metres.
    """
    cells = np.floor(axes / voxel_m)
    cells -= cells.min(axis=1, keepdims=True)
    if cells.max() < _VOXELS_MAX:
        whole = cells.astype(np.int64)
        keys = (whole[0] << 42) | (whole[1] << 21) | whole[2]
        _, first = np.unique(keys, return_index=True)
    else:
        _, first = np.unique(cells, axis=1, return_index=True)
    return np.sort(first)


def _points_of(tree: object) -> npt.NDArray[np.uint8] | None:
    """Return the bytes of the points, uint8 [points, point_step]; None where the tree is no consistent cloud."""
    match tree:
        case {
            "width": int(width),
            "height": int(height),
            "point_step": int(point_step),
            "row_step": int(row_step),
            "is_dense": int(),
            "data": memoryview() as data,
        }:
            pass
        case _:
            return None
    row_bytes = width * point_step
    if not point_step or row_step < row_bytes or len(data) != height * row_step:
        return None
    rows = np.frombuffer(data, np.uint8).reshape(height, row_step)
    return np.ascontiguousarray(rows[:, :row_bytes]).reshape(-1, point_step)


def _axes_of(tree: Tree, points: npt.NDArray[np.uint8]) -> _Axes | None:
    """Return the positions, float64 [3, points]; None where x, y or z is missing or no float."""
    order = ">" if tree.get("is_bigendian") else "<"
    formats: dict[str, tuple[str, int]] = {}
    fields = tree.get("fields")
    for field in fields if isinstance(fields, Sequence) else ():
        match field:
            case {"name": memoryview() as name, "offset": int(offset), "datatype": int(kind)} if kind in _FORMATS:
                formats[bytes(name[:8]).decode("ascii", "replace")] = order + _FORMATS[kind], offset
    if not {"x", "y", "z"} <= formats.keys():
        return None
    names = ["x", "y", "z"]
    offsets = [formats[name][1] for name in names]
    dtypes = [np.dtype(formats[name][0]) for name in names]
    if any(at + dtype.itemsize > points.shape[1] for at, dtype in zip(offsets, dtypes, strict=True)):
        return None
    layout = np.dtype({"names": names, "formats": dtypes, "offsets": offsets, "itemsize": points.shape[1]})
    records = points.view(layout)[:, 0]
    return np.stack([records[name].astype(np.float64) for name in names])


def _is_inside(axes: _Axes, region: Region) -> npt.NDArray[np.bool_]:
    inside = np.ones(axes.shape[1], np.bool_)
    for values in axes:
        np.logical_and(inside, np.isfinite(values), out=inside)
    bounds: tuple[Bounds | None, ...] = region.x, region.y, region.z
    for values, limits in zip(axes, bounds, strict=True):
        if limits is not None:
            np.logical_and(inside, (values >= limits[0]) & (values < limits[1]), out=inside)
    return inside
