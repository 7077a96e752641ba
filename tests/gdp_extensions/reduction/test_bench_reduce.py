"""The bench of reductions: its synthetic messages come back, and what it reports is measured."""

from __future__ import annotations

import numpy as np
import pytest
from reduce import CLOUD, Case, cloud, described, image, measure_one, zstd_of

from gdp_extensions.reduction.picture import HAS_LIBRARY
from proxy.config.reduction import IMAGE, Region

ROWS, COLUMNS = np.mgrid[0:480, 0:640]
WAVES = 128 + 60 * np.sin(ROWS / 37) + 50 * np.cos(COLUMNS / 53)
PICTURE = np.clip(WAVES + np.random.default_rng(1).normal(0, 3, WAVES.shape), 0, 255).astype(np.uint8)


def test_a_synthetic_map_shrinks_and_comes_back() -> None:
    case = Case("image", described(IMAGE), [image("mono8", np.zeros((48, 64), np.uint8))], {})
    found = measure_one(case, zstd_of(3), 0)
    assert found["bytes"] < 200
    assert found["sending, ms"] > 0


@pytest.mark.skipif(not HAS_LIBRARY, reason="Pillow is not installed")
def test_a_synthetic_picture_is_smaller_as_a_jpeg_than_as_a_png() -> None:
    case = Case("image", described(IMAGE), [image("mono8", PICTURE)], {})
    sizes = [
        measure_one(case, settings, 0)["bytes"] for settings in ({"image": "jpeg", "quality": 50}, {"image": "png"})
    ]
    assert sizes[0] < sizes[1] < PICTURE.size


def test_half_of_a_cloud_is_half_of_its_bytes() -> None:
    points = np.random.default_rng(1).uniform(-1, 1, (1_000, 4)).astype(np.float32)
    case = Case("cloud", described(CLOUD), [cloud(points)], {})
    found = measure_one(case, {"region": Region(x=(0, 2))}, 0)
    assert found["bytes"] < 0.6 * len(cloud(points))
