"""Compressed bodies: they come back as they were, cost nothing where nothing is gained, and cannot exhaust memory."""

from __future__ import annotations

import random
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import LocalError, RemoteError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp_extensions.reduction.compression import BodyCompressor, BodyDecompressor, check_dictionary
from gdp_extensions.reduction.encoder import body_max_bytes
from proxy.wire.message import DICTIONARY_MAX_BYTES

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

RANDOM = random.Random(1)
NOISE = RANDOM.randbytes(4_000)


def dictionary() -> bytes:
    samples = [b'{"frame_id": "base_%d", "x": %d, "y": %d}' % (each % 7, each, each * each) for each in range(2_000)]
    trained: bytes = zstd.train_dict(samples, 4_096).dict_content
    return trained


DICTIONARY = dictionary()


@given(st.binary(min_size=1, max_size=200), st.integers(2, 50), st.sampled_from((1, 3, 19)))
def test_a_body_that_repeats_itself_comes_back_as_it_was(part: bytes, times: int, level: int) -> None:
    body = part * times
    frame = BodyCompressor(level).compress(body)
    assert frame is None or BodyDecompressor(len(body)).decompress(frame) == body


def test_a_body_that_would_not_shrink_travels_as_it_is() -> None:
    assert BodyCompressor(3).compress(NOISE) is None


def test_a_topic_that_never_shrinks_is_tried_ever_more_seldom() -> None:
    compressor = BodyCompressor(3)
    tried = 0
    original = compressor._compressor

    class Counting:
        FLUSH_FRAME = original.FLUSH_FRAME

        def compress(self, body: bytes, mode: int) -> bytes:
            nonlocal tried
            tried += 1
            frame: bytes = original.compress(body, mode)
            return frame

    compressor._compressor = Counting()
    for _ in range(2_000):
        assert compressor.compress(NOISE) is None
    assert tried < 20


def test_a_topic_that_shrinks_again_is_compressed_again() -> None:
    compressor = BodyCompressor(3)
    for _ in range(1_000):
        compressor.compress(NOISE)
    assert any(compressor.compress(bytes(4_000)) for _ in range(300))
    assert compressor.compress(bytes(4_000)) is not None


def test_a_dictionary_makes_short_bodies_shorter() -> None:
    body = b'{"frame_id": "base_3", "x": 4711, "y": 22193521}'
    frame = BodyCompressor(3, DICTIONARY).compress(body)
    assert frame is not None
    assert len(frame) < len(body) - 15
    assert BodyDecompressor(100, DICTIONARY).decompress(frame) == body


def test_a_frame_of_another_dictionary_is_refused() -> None:
    frame = BodyCompressor(3, DICTIONARY).compress(b'{"frame_id": "base_3", "x": 4711, "y": 22193521}')
    assert frame is not None
    with pytest.raises(RemoteError):
        BodyDecompressor(100).decompress(frame)


def test_a_frame_that_expands_beyond_the_limit_is_refused() -> None:
    frame = BodyCompressor(3).compress(bytes(10 << 20))
    assert frame is not None
    with pytest.raises(RemoteError, match="more than 1000 bytes"):
        BodyDecompressor(1_000).decompress(frame)


@given(st.binary(max_size=100))
def test_arbitrary_bytes_are_a_frame_or_a_remote_error(frame: bytes) -> None:
    try:
        BodyDecompressor(1_000).decompress(frame)
    except RemoteError:
        return


@pytest.mark.parametrize("change", [lambda frame: frame[:-1], lambda frame: frame + b"\0", lambda frame: frame * 2])
def test_what_is_not_exactly_one_frame_is_refused(change: object) -> None:
    frame = BodyCompressor(3).compress(bytes(1_000))
    assert frame is not None
    assert callable(change)
    with pytest.raises(RemoteError):
        BodyDecompressor(5_000).decompress(change(frame))


def test_a_far_dictionary_that_is_none_is_refused() -> None:
    with pytest.raises(RemoteError):
        BodyDecompressor(1_000, b"no dictionary at all").decompress(b"")


@pytest.mark.parametrize("content", [b"x", b"a text" * 20, b"\x37\xa4\x30\xec" + b"abcd" * 20])
def test_a_file_that_is_no_dictionary_is_refused_at_home(content: bytes) -> None:
    with pytest.raises(LocalError, match="zstd --train"):
        check_dictionary(content)


def test_a_dictionary_too_long_for_a_description_is_refused_at_home() -> None:
    with pytest.raises(LocalError, match=f"--maxdict={DICTIONARY_MAX_BYTES}"):
        check_dictionary(bytes(DICTIONARY_MAX_BYTES + 1))


def test_a_trained_dictionary_is_accepted() -> None:
    assert check_dictionary(DICTIONARY) == DICTIONARY


def test_bodies_are_bounded_by_what_their_messages_may_have() -> None:
    assert body_max_bytes("cdr", 1_000) == 1_000
    assert body_max_bytes("json", 1_000) == 16_000 + (64 << 10)
    assert body_max_bytes("json", MESSAGE_MAX_BYTES) == MESSAGE_MAX_BYTES
