"""Thinned point clouds: one measured point of each voxel crosses, with all its fields."""

from __future__ import annotations

import numpy as np
import pytest

from gdp_extensions.reduction.cloud import CloudReducer
from proxy.config.reduction import CLOUD, Region
from proxy.serial.channel import RosVersion
from tests.gdp_extensions.reduction.samples import channel, cloud, cloud_of

RANDOM = np.random.default_rng(1)
POINTS = np.column_stack([RANDOM.uniform(-2, 2, (5_000, 3)), np.arange(5_000)]).astype(np.float32)


@pytest.mark.parametrize("ros", [1, 2])
def test_each_voxel_keeps_its_first_point_with_all_fields(ros: RosVersion) -> None:
    reduced = CloudReducer(channel(CLOUD, ros), 0.5, None).reduce(cloud(POINTS, rows=10, ros=ros))
    message, points = cloud_of(reduced, ros)
    cells = [tuple(each) for each in np.floor(POINTS[:, :3] / 0.5).astype(int).tolist()]
    first = _first(cells)
    assert points.tolist() == POINTS[first].tolist()
    assert (message.height, message.width, message.row_step) == (1, len(first), 16 * len(first))
    assert message.is_dense
    assert message.header.frame_id == "lens"
    assert [field.name for field in message.fields] == ["x", "y", "z", "intensity"]


def _first(cells: list[tuple[int, ...]]) -> list[int]:
    seen: dict[tuple[int, ...], int] = {}
    for at, cell in enumerate(cells):
        seen.setdefault(cell, at)
    return sorted(seen.values())


def test_points_without_a_finite_position_do_not_cross() -> None:
    points = POINTS[:10].copy()
    points[3, 1], points[4, 2] = np.nan, np.inf
    _, kept = cloud_of(CloudReducer(channel(CLOUD), 0.001, None).reduce(cloud(points)))
    assert kept[:, 3].tolist() == [0, 1, 2, 5, 6, 7, 8, 9]


def test_only_the_points_of_the_region_cross() -> None:
    reducer = CloudReducer(channel(CLOUD), None, Region(x=(0, 1), z=(-0.5, 0.5)))
    _, kept = cloud_of(reducer.reduce(cloud(POINTS)))
    x, _, z, _ = POINTS.T
    assert kept.tolist() == POINTS[(x >= 0) & (x < 1) & (z >= -0.5) & (z < 0.5)].tolist()


def test_a_cloud_outside_the_region_crosses_empty() -> None:
    message, kept = cloud_of(CloudReducer(channel(CLOUD), 0.1, Region(x=(50, 60))).reduce(cloud(POINTS)))
    assert (len(kept), message.width, len(message.data)) == (0, 0, 0)


def test_a_cloud_that_loses_no_point_crosses_unchanged() -> None:
    raw = cloud(POINTS[:3], rows=3)
    assert CloudReducer(channel(CLOUD), 1e-4, None).reduce(raw) == raw


def test_points_that_lie_far_apart_stay_apart() -> None:
    points = np.array([[0, 0, 0, 1], [1e9, 0, 0, 2], [0, 1e-3, 0, 3], [-1e9, 0, 5, 4]], np.float32)
    _, kept = cloud_of(CloudReducer(channel(CLOUD), 0.01, None).reduce(cloud(points)))
    assert kept[:, 3].tolist() == [1, 2, 4]


def test_bytes_that_are_no_cloud_cross_unchanged() -> None:
    assert CloudReducer(channel(CLOUD), 0.1, None).reduce(b"\0\1\0\0abc") == b"\0\1\0\0abc"
