"""Decoder of recordings in this process: it reads what the reader gets from the confined process."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from proxy.recordings.decoder import BagDecoder
from proxy.recordings.reader import BagReader
from tests.proxy.recordings.samples import READABLE, recording
from tests.proxy.recordings.test_reader import compressed_mcap, cut, numbered, record


def short_bag(folder: Path) -> Path:
    """Return a ROS 1 bag that ends in the middle."""
    record(folder / "a.bag", 1, numbered(1, 5_000))
    return cut(folder / "a.bag", 0.5)


def short_mcap(folder: Path) -> Path:
    """Return an MCAP file that ends in the middle."""
    return cut(compressed_mcap(folder / "a", numbered(2, 5_000)), 0.5)


def short_database(folder: Path) -> Path:
    """Return a database that ends in the middle."""
    shutil.copy(recording("rosbag2_test") / "rosbag2_test_0.db3", folder / "a.db3")
    return cut(folder / "a.db3", 0.5)


def folder_of_short_files(folder: Path) -> Path:
    """Return a folder whose only storage file ends in the middle."""
    short_mcap(folder).rename(folder / "a" / "a.mcap")
    return folder / "a"


@pytest.mark.parametrize("name", READABLE)
def test_a_whole_recording_is_decoded_as_the_reader_shows_it(name: str) -> None:
    with BagDecoder(recording(name)) as decoder, BagReader(recording(name)) as reader:
        assert decoder.channels == reader.channels
        assert decoder.count == reader.count
        assert list(decoder.messages()) == list(reader.messages())


@pytest.mark.parametrize("make", [short_bag, short_mcap, short_database, folder_of_short_files])
def test_a_truncated_recording_is_decoded_as_the_reader_shows_it(make: Callable[[Path], Path], tmp_path: Path) -> None:
    path = make(tmp_path)
    with BagDecoder(path) as decoder, BagReader(path) as reader:
        assert list(decoder.messages()) == list(reader.messages())
        assert decoder.unread == reader.unread != ""
