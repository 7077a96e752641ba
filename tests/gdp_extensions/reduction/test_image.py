"""Reduced images: what arrives is the image of its kind, with header, size and step kept."""

from __future__ import annotations

import random

import numpy as np
import numpy.typing as npt
import pytest

from gdp.errors import RemoteError
from gdp_extensions.reduction.image import ImageReducer, ImageRestorer
from gdp_extensions.reduction.picture import HAS_LIBRARY
from proxy.config.reduction import IMAGE, Region
from proxy.serial.channel import RosVersion
from proxy.wire.message import PictureFormat
from tests.gdp_extensions.reduction.samples import channel, image, image_of, pixels_of

pytestmark = pytest.mark.skipif(not HAS_LIBRARY, reason="Pillow is not installed")

MAX_BYTES = 1 << 20
SHADE = np.add.outer(np.arange(48), np.arange(64))  # [48, 64], 0 to 110


def pixels(encoding: str) -> npt.NDArray[np.generic]:
    """Return a smooth picture, [height, width, channels]."""
    kind = np.uint16 if "16" in encoding else np.float32 if "32F" in encoding else np.uint8
    count = 4 if "a8" in encoding else 3 if encoding in ("rgb8", "bgr8") else 1
    return np.stack([SHADE * (each + 1) % 256 for each in range(count)], axis=-1).astype(kind)


def there_and_back(raw: bytes, picture: PictureFormat, ros: RosVersion = 2, quality: int = 90) -> tuple[bytes, bytes]:
    """Return what travels, and what arrives."""
    reduced, is_file = ImageReducer(channel(IMAGE, ros), picture, None).reduce(raw, quality)
    assert is_file
    return reduced, ImageRestorer(channel(IMAGE, ros), picture, MAX_BYTES).restore(reduced)


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "rgba8", "bgra8", "mono16", "16UC1", "bayer_rggb8"])
@pytest.mark.parametrize("pad", [0, 8])
def test_a_png_brings_every_pixel_and_field_back(encoding: str, pad: int, ros: RosVersion) -> None:
    raw = image(encoding, SHADE.shape, pixels(encoding), ros=ros, pad=pad)
    reduced, restored = there_and_back(raw, "png", ros)
    assert len(reduced) < len(raw)
    assert restored == raw


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8"])
def test_a_jpeg_brings_colours_back_in_their_order(encoding: str) -> None:
    raw = image(encoding, SHADE.shape, pixels(encoding), pad=4)
    _, restored = there_and_back(raw, "jpeg", quality=95)
    sent, received = image_of(raw), image_of(restored)
    assert received.header == sent.header
    assert (received.width, received.height, received.step) == (sent.width, sent.height, sent.step)
    assert (received.encoding, received.is_bigendian) == (encoding, 0)
    difference = np.abs(pixels_of(raw).astype(int) - pixels_of(restored))
    assert difference.mean() < 6


def test_a_lower_quality_makes_a_jpeg_smaller() -> None:
    noise = np.random.default_rng(1).normal(128, 20, (48, 64, 3)).astype(np.uint8)
    reducer = ImageReducer(channel(IMAGE), "jpeg", None)
    sizes = [len(reducer.reduce(image("bgr8", (48, 64), noise), quality)[0]) for quality in (20, 50, 90)]
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[2] / 2


@pytest.mark.parametrize(
    ("encoding", "picture"),
    [("32FC1", "png"), ("32FC1", "jpeg"), ("16UC1", "jpeg"), ("rgba8", "jpeg"), ("yuv422", "png")],
)
def test_an_encoding_without_such_a_file_travels_as_it_is(encoding: str, picture: PictureFormat) -> None:
    raw = image(encoding, SHADE.shape, pixels(encoding))
    assert ImageReducer(channel(IMAGE), picture, None).reduce(raw, 80) == (raw, False)


def test_an_image_that_a_file_would_not_shorten_travels_as_it_is() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (48, 64, 3), np.uint8)
    raw = image("bgr8", (48, 64), noise)
    assert ImageReducer(channel(IMAGE), "png", None).reduce(raw, 80) == (raw, False)


def test_big_endian_depth_travels_as_it_is() -> None:
    raw = image("16UC1", SHADE.shape, pixels("16UC1"), order=1)
    assert ImageReducer(channel(IMAGE), "png", None).reduce(raw, 80) == (raw, False)


def test_only_the_pixels_of_the_region_cross() -> None:
    raw = image("mono8", SHADE.shape, pixels("mono8"), pad=3)
    cut, is_file = ImageReducer(channel(IMAGE), None, Region(x=(10, 30), y=(5, 6))).reduce(raw, 80)
    assert not is_file
    assert image_of(cut).header == image_of(raw).header
    assert pixels_of(cut).tolist() == [pixels_of(raw)[5, 10:30].tolist()]


def test_a_region_beyond_the_image_ends_with_it_and_one_outside_cuts_nothing() -> None:
    raw = image("mono8", SHADE.shape, pixels("mono8"))
    cut, _ = ImageReducer(channel(IMAGE), None, Region(x=(60, 900))).reduce(raw, 80)
    assert (image_of(cut).width, image_of(cut).height) == (4, 48)
    assert ImageReducer(channel(IMAGE), None, Region(x=(64, 900))).reduce(raw, 80) == (raw, False)


def test_a_cut_keeps_the_pattern_of_a_bayer_image() -> None:
    raw = image("bayer_rggb8", SHADE.shape, pixels("mono8"))
    cut, _ = ImageReducer(channel(IMAGE), None, Region(x=(3, 7), y=(1, 4))).reduce(raw, 80)
    assert pixels_of(cut).tolist() == pixels_of(raw)[0:4, 2:8].tolist()


def test_bytes_that_are_no_image_travel_as_they_are() -> None:
    assert ImageReducer(channel(IMAGE), "png", None).reduce(b"\0\1\0\0abc", 80) == (b"\0\1\0\0abc", False)


def test_an_image_larger_than_the_readers_limit_is_refused_before_it_is_unpacked() -> None:
    raw = image("mono8", SHADE.shape, pixels("mono8"))
    reduced, _ = ImageReducer(channel(IMAGE), "png", None).reduce(raw, 80)
    with pytest.raises(RemoteError, match="more than 1000 bytes"):
        ImageRestorer(channel(IMAGE), "png", 1_000).restore(reduced)


def test_a_file_of_another_size_than_stated_is_refused() -> None:
    small = image("mono8", (4, 64), pixels("mono8")[:4])
    reduced, _ = ImageReducer(channel(IMAGE), "png", None).reduce(image("mono8", SHADE.shape, pixels("mono8")), 80)
    forged = reduced.replace((48).to_bytes(4, "little") + (64).to_bytes(4, "little"), (4).to_bytes(4, "little") * 2, 1)
    assert small != forged != reduced
    with pytest.raises(RemoteError):
        ImageRestorer(channel(IMAGE), "png", MAX_BYTES).restore(forged)


@pytest.mark.parametrize("picture", ["jpeg", "png"])
def test_damaged_files_are_restored_somehow_or_a_remote_error(picture: PictureFormat) -> None:
    raw = image("bgr8", SHADE.shape, pixels("bgr8"))
    reduced, _ = ImageReducer(channel(IMAGE), picture, None).reduce(raw, 80)
    restorer, chance = ImageRestorer(channel(IMAGE), picture, MAX_BYTES), random.Random(1)
    outcomes = set()
    for _ in range(300):
        damaged = bytearray(reduced)
        damaged[chance.randrange(60, len(damaged))] ^= 1 << chance.randrange(8)
        try:
            outcomes.add(len(restorer.restore(bytes(damaged))) > 0)
        except RemoteError:
            outcomes.add(False)
    assert False in outcomes
