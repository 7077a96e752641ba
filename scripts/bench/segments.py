"""Segments bench: processor time of sealing and opening an image by fragments, and by segments cut into frames.

    .venv/bin/python scripts/bench/segments.py [--rounds 5] [--count 10] [--json FILE]

One thread, no network, no root. ``fragments`` is the envelope: one call of the cipher for each frame. ``segments N`` is
an experiment: one call for N bytes, whose ciphertext is cut into frames afterwards. Headers, additional data, the
digest under the signature and the comparison of received headers are the same in both. A frame can only be checked with
its whole segment; ``at stake`` is how many frames one injected frame makes useless until they are sent again.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from report import Rounds, progress
from skeleton import Options, Outcome, command_line, run_bench

from gdp.crypto.envelope import SALT_BYTES, SEAL_BYTES, TAG_BYTES, Opener, Sealer, fragment_capacity
from gdp.crypto.header_batch import HeaderBatch
from gdp.frame.codec import HEADER_BYTES, Header, authenticated, decode
from gdp.frame.kinds import Kind
from gdp.host.run_registry import RunRegistry
from gdp.limits import HOPS_MAX
from gdp.sansio import ReceivedFrame

MTUS: Final = (1_500, 9_000)
SEGMENT_BYTES: Final = (4_096, 16_384)
IMAGE_BYTES: Final = 921_600
SEAL_MS, OPEN_MS, EXTRA, STAKE = "seal, ms", "open, ms", "extra bytes", "at stake"
FRAGMENTS: Final = "fragments"
_SECRET, _NAME = bytes(32), bytes(range(32))
_INCARNATION: Final = 1


class ByFragments:
    """The envelope."""

    frames_at_stake = 1

    def __init__(self, mtu: int) -> None:
        self._mtu, self._number = mtu, 0
        self._sealer = Sealer(
            secret=_SECRET,
            epoch=1,
            kind=Kind.DATA,
            source=_NAME,
            incarnation=_INCARNATION,
            destination=_NAME,
            signer=None,
            random_bytes=os.urandom,
        )
        self._opener = Opener(_SECRET, Kind.DATA, _NAME, _INCARNATION, _NAME, is_signed=False)

    def seal(self, message: bytes) -> list[bytes]:
        """Return the frames of a message."""
        self._number += 1
        running = hashlib.sha256()
        frames = self._sealer.seal(self._number, 0, message, self._mtu)[:]
        for frame in frames:
            running.update(frame[HEADER_BYTES + SALT_BYTES :])
        return frames

    def open(self, frames: Sequence[bytes]) -> bytes:
        """Return the message of frames in order."""
        running, header = hashlib.sha256(), decode(frames[0], 0)
        salt = frames[0][HEADER_BYTES : HEADER_BYTES + SALT_BYTES]
        count = header.parts - 2  # the last two may be shorter
        arrivals = [ReceivedFrame(0, b"", frame) for frame in frames[:count]]
        batch = HeaderBatch(header, 0, count, salt)
        plains, payloads = self._opener.open_run(batch, 0, header.length, arrivals, 0)
        for payload in payloads:
            running.update(payload)
        plains += [self._opener.open(decode(frame, 0), frame)[0] for frame in frames[count:]]
        return b"".join(plains)


class BySegments:
    """The experiment: one seal for ``segment_bytes``, cut into frames of which only the last has a tag."""

    def __init__(self, mtu: int, segment_bytes: int) -> None:
        self._capacity = fragment_capacity(mtu) + SEAL_BYTES - SALT_BYTES  # the salt stays, the tags do not
        self.frames_at_stake = -(-(segment_bytes + TAG_BYTES) // self._capacity)
        self._segment_bytes = self.frames_at_stake * self._capacity - TAG_BYTES  # full frames only
        self._aead, self._salt = AESGCM(_SECRET), os.urandom(SALT_BYTES)
        self._number = 0

    def _headers(self, size: int) -> tuple[list[bytes], list[bytes], list[bytes]]:
        parts = -(-(size + -(-size // self._segment_bytes) * TAG_BYTES) // self._capacity)
        length = self._capacity + SALT_BYTES
        header = Header(Kind.DATA, 0, HOPS_MAX, 1, length, self._number, 0, parts, _INCARNATION, _NAME, _NAME)
        columns = HeaderBatch(header, 0, parts, self._salt).each()
        heads, additional, nonces = ([each for (each,) in column] for column in columns)
        return heads, additional, nonces

    def seal(self, message: bytes) -> list[bytes]:
        """Return the frames of a message."""
        self._number += 1
        heads, additional, nonces = self._headers(len(message))
        running, view, frames, capacity = hashlib.sha256(), memoryview(message), list[bytes](), self._capacity
        for begin in range(0, len(message), self._segment_bytes):
            part = len(frames)
            sealed = self._aead.encrypt(nonces[part], view[begin : begin + self._segment_bytes], additional[part])
            running.update(sealed)
            cuts = range(0, len(sealed), capacity)
            frames += [head + sealed[at : at + capacity] for head, at in zip(heads[part:], cuts, strict=False)]
        return frames

    def open(self, frames: Sequence[bytes]) -> bytes:
        """Return the message of frames in order."""
        running, plains = hashlib.sha256(), []
        heads, _, nonces = self._headers(IMAGE_BYTES)
        body_at = HEADER_BYTES + SALT_BYTES
        for part in range(0, len(frames), self.frames_at_stake):
            group = frames[part : part + self.frames_at_stake]
            if any(frame[:body_at] != head for frame, head in zip(group, heads[part:], strict=False)):
                raise RuntimeError("a frame of another message")
            sealed = b"".join([frame[body_at:] for frame in group])
            running.update(sealed)
            plains.append(self._aead.decrypt(nonces[part], sealed, authenticated(group[0])))
        return b"".join(plains)


def _least_ms(work: Callable[[], object], count: int) -> float:
    """Return the least processor time of ``count`` runs in milliseconds: others on the same core only add to it."""
    times = []
    for _ in range(count):
        begun_s = time.thread_time()
        work()
        times.append(time.thread_time() - begun_s)
    return 1e3 * min(times)


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure all ways in turn, round by round."""
    del runs
    over, message = Rounds(), os.urandom(IMAGE_BYTES)
    for number in range(options.rounds):
        progress(f"round {number + 1}/{options.rounds}")
        for mtu in MTUS:
            case = f"image, MTU {mtu}"
            ways: dict[str, ByFragments | BySegments] = {FRAGMENTS: ByFragments(mtu)}
            ways |= {f"segments {size}": BySegments(mtu, size) for size in SEGMENT_BYTES}
            for kind, way in ways.items():
                over.add(kind, case, SEAL_MS, _least_ms(partial(way.seal, message), options.count))
                frames = way.seal(message)
                if way.open(frames) != message:
                    raise RuntimeError(f"{kind}: the image is not the one that was sealed")
                over.add(kind, case, OPEN_MS, _least_ms(partial(way.open, frames), options.count))
                over.add(kind, case, EXTRA, sum(map(len, frames)) - IMAGE_BYTES)
                over.add(kind, case, STAKE, way.frames_at_stake)
    targets = [
        over.ratio(f"{case}: segments {size} / fragments, {column}", f"segments {size}", FRAGMENTS, case, column, None)
        for case in over.cases()
        for size in SEGMENT_BYTES
        for column in (SEAL_MS, OPEN_MS)
    ]
    settings = {"rounds": options.rounds, "count": options.count}
    return Outcome("segments", "Sealing by segments", over, targets, settings, is_whole=False)


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=5, has_record=True)
    parser.add_argument("--count", type=int, default=10, help="images of a trial")
    run_bench(parser, measure)
