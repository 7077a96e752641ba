"""Thread offload bench: benefit of a separate thread for hashing or verification, both ways in one process and run.

    .venv/bin/python scripts/bench/thread_offload.py [--rounds 5] [--count 60] [--json FILE]

One process, without a network. An image of 921,600 bytes is sealed as parts for MTU 1500 and hashed as they come, in
place and by a second thread. A small message is verified in place and by a second thread. Work of a thread must be
handed over and awaited, and a thread helps only while the interpreter's lock is released. The time that two threads
take for twice the work shows how far: 1 for parallel, 2 for one after the other.
"""

from __future__ import annotations

import hashlib
import secrets
import statistics
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from report import Rounds, progress
from skeleton import Options, Outcome, command_line, run_bench

from gdp.crypto.keys import SigningKey
from gdp.host.run_registry import RunRegistry

IMAGE_BYTES = 921_600
CAPACITY_BYTES = 1_388  # plaintext in a part at MTU 1500
CHUNK_PARTS = 64
ADDITIONAL = bytes(95)
LARGE = secrets.token_bytes(8 << 20)

Hash = Callable[[list[bytes]], None]


def seal(aead: AESGCM, image: memoryview, take: Hash) -> None:
    """Encrypt part by part, passing each chunk of parts to ``take``."""
    chunk: list[bytes] = []
    for number, begin in enumerate(range(0, len(image), CAPACITY_BYTES)):
        part = aead.encrypt(number.to_bytes(12, "big"), image[begin : begin + CAPACITY_BYTES], ADDITIONAL)
        chunk.append(part)
        if len(chunk) == CHUNK_PARTS:
            take(chunk)
            chunk = []
    take(chunk)


def in_place(aead: AESGCM, image: memoryview) -> None:
    """Seal and hash an image in this thread."""
    update = hashlib.sha256().update

    def take(chunk: list[bytes]) -> None:
        for part in chunk:
            update(part)

    seal(aead, image, take)


def neighbouring(worker: ThreadPoolExecutor, aead: AESGCM, image: memoryview) -> None:
    """Seal an image in this thread and hash it in another."""
    running = hashlib.sha256()
    under_way: list[Future[None]] = []

    def take(chunk: list[bytes]) -> None:
        while under_way:
            under_way.pop().result()
        under_way.append(worker.submit(running.update, b"".join(chunk)))

    seal(aead, image, take)
    under_way.pop().result()


def by_two(work: Callable[[], object]) -> None:
    """Run the same work in two threads at the same time."""
    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def median_ms(work: Callable[[], object], count: int) -> float:
    """Return the median time of a call, in milliseconds."""
    times = []
    for _ in range(count):
        begun_s = time.perf_counter()
        work()
        times.append(time.perf_counter() - begun_s)
    return statistics.median(times) * 1e3


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure both ways in turn, round by round."""
    del runs
    over = Rounds()
    aead, image = AESGCM(secrets.token_bytes(32)), memoryview(secrets.token_bytes(IMAGE_BYTES))
    key, digest = SigningKey.generate(), secrets.token_bytes(32)
    verify = partial(key.public.verify_digest, key.sign_digest(digest), digest)
    encrypt_large = partial(aead.encrypt, bytes(12), LARGE, None)
    hash_large = partial(hashlib.sha256, LARGE)
    with ThreadPoolExecutor(1) as worker:
        for number in range(options.rounds):
            progress(f"round {number + 1}/{options.rounds}")
            for who, seal_by, verify_by in (
                ("in place", partial(in_place, aead, image), verify),
                ("thread", partial(neighbouring, worker, aead, image), lambda: worker.submit(verify).result()),
            ):
                over.add(who, "an image sealed", "ms", median_ms(seal_by, options.count))
                over.add(who, "a message verified", "ms", median_ms(verify_by, 10 * options.count))
            for who, work in ("AES-GCM", encrypt_large), ("SHA-256", hash_large):
                both = median_ms(partial(by_two, work), 5) / median_ms(work, 5)
                over.add(who, "two threads, twice the work", "time ratio", both)
    targets = [
        over.ratio("thread / in place, image", "thread", "in place", "an image sealed", "ms", None),
        over.ratio("thread / in place, verify", "thread", "in place", "a message verified", "ms", None),
    ]
    settings = {"rounds": options.rounds, "count": options.count}
    title = "Hashing and verifying in this thread and in another"
    return Outcome("thread_offload", title, over, targets, settings, is_whole=False)


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=5, has_record=True)
    parser.add_argument("--count", type=int, default=60, help="images in a round; small messages: ten times that")
    run_bench(parser, measure)
