"""Serializer on every message of the shared recordings."""

from __future__ import annotations

from typing import get_args

import pytest

from proxy.recordings.reader import BagReader
from proxy.serial.serializer import Encoding, Serializer, canonical
from tests.proxy.recordings.samples import READABLE, recording


@pytest.mark.parametrize("encoding", get_args(Encoding))
@pytest.mark.parametrize("name", READABLE)
def test_every_message_of_a_recording_comes_back_identical(name: str, encoding: Encoding) -> None:
    with BagReader(recording(name)) as bag:
        ends = [Serializer(channel, encoding) for channel in bag.channels]
        assert not any(end.opaque for end in ends)
        for message in bag.messages():
            end = ends[message.channel]
            body = end.encode(message.raw)
            same = message.raw if encoding == "cdr" else canonical(end.channel, message.raw)
            assert end.decode(body) == same
            assert encoding == "cdr" or b"$raw" not in body[:12]
