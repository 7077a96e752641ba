"""Decoders under libFuzzer, guided by the branches that an input runs (atheris).

libFuzzer owns the process that it runs in and ends it, so each decoder gets a child, forked after all modules were
imported with instrumentation. Numbers come back through shared memory, findings and new inputs as files.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import os
import random
import struct
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from tests.fuzzing.decoder import Decoder
from tests.fuzzing.mutation import mutated
from tests.fuzzing.runner import Finding, Outcome, corpus_of, measured_bytes, timed_ms, watched

__all__ = ["guided", "instrumented_decoders"]

_NUMBERS: Final = struct.Struct("QQQdd")  # executions, refused, foreign, slowest ms, memory ratio
_MEMORY_EVERY: Final = 64
_MEMORY_LEAST_BYTES: Final = 64 << 10
_REPEATS: Final = 3  # of an execution that took too long: the machine may be busy
_OTHERS: Final = 4  # inputs of the corpus in addition to the mutated one


def instrumented_decoders() -> tuple[Decoder, ...]:
    """Import the project with instrumentation, and return its decoders.

    Raises:
        ImportError: there is no atheris here.
    """
    import atheris

    with atheris.instrument_imports(include=["gdp", "proxy", "fog", "gdp_extensions"]):
        from tests.fuzzing.registry import DECODERS
    return DECODERS


def guided(decoder: Decoder, seconds: float, seed: int) -> Outcome:
    """Run a decoder under libFuzzer in a child; return the result."""
    shared = mmap.mmap(-1, _NUMBERS.size)
    with tempfile.TemporaryDirectory(prefix="gdp-fuzz-") as name:
        folder = Path(name)
        for each in ("seeds", "new", "findings"):
            (folder / each).mkdir()
        for number, data in enumerate(corpus_of(decoder)):
            (folder / "seeds" / str(number)).write_bytes(data)
        sys.stdout.flush()
        child = os.fork()
        if child == 0:
            _fuzz(decoder, seconds, seed, folder, shared)
            os._exit(3)  # libFuzzer ends the process itself
        _, status = os.waitpid(child, 0)
        outcome = Outcome(decoder)
        outcome.executions, outcome.refused, outcome.foreign, *rest = _NUMBERS.unpack_from(shared)
        outcome.slowest_ms, outcome.memory_ratio = rest
        for path in sorted((folder / "findings").glob("*.json")):
            finding = json.loads(path.read_text())
            outcome.findings[finding["place"]] = Finding(
                bytes.fromhex(finding["data"]), finding["error"], finding["excess"]
            )
        if status != 0:
            log = (folder / "log").read_text(errors="replace")[-400:]
            crash = next(iter(folder.glob("crash-*")), None)
            outcome.foreign += 1
            outcome.findings["process"] = Finding(b"" if crash is None else crash.read_bytes(), f"{status}: {log}")
        outcome.found = [path.read_bytes() for path in sorted((folder / "new").iterdir())]
    return outcome


def _fuzz(decoder: Decoder, seconds: float, seed: int, folder: Path, shared: mmap.mmap) -> None:
    import atheris

    log = os.open(folder / "log", os.O_WRONLY | os.O_CREAT)
    os.dup2(log, 2)
    arguments = [
        "fuzz", f"-max_total_time={max(int(seconds), 1)}", f"-seed={seed}", f"-max_len={decoder.size_max}",
        "-timeout=60", "-rss_limit_mb=2048", f"-artifact_prefix={folder}/", "-verbosity=0", *_words(decoder, folder),
        str(folder / "new"), str(folder / "seeds"),
    ]  # fmt: skip
    with watched():
        tried = _Tried(decoder, folder / "findings", shared)
        atheris.Setup(arguments, tried, custom_mutator=_mutator(decoder))
        atheris.Fuzz()


def _words(decoder: Decoder, folder: Path) -> list[str]:
    """Return the option that names a dictionary of the decoder's tokens, if it has some."""
    if not decoder.tokens:
        return []
    path = folder / "words"
    path.write_text("".join('"' + "".join(f"\\x{byte:02x}" for byte in word) + '"\n' for word in decoder.tokens))
    return [f"-dict={path}"]


def _mutator(decoder: Decoder) -> Callable[[bytes, int, int], bytes]:
    """Return a mutator: libFuzzer's own, and half of the time that of the runner, which knows CBOR."""
    import atheris

    corpus: Sequence[bytes] = corpus_of(decoder)

    def mutate(data: bytes, maximum: int, seed: int) -> bytes:
        if seed & 1:
            return bytes(atheris.Mutate(data, maximum))
        rng = random.Random(seed)
        return mutated(decoder, [bytes(data), *rng.choices(corpus, k=_OTHERS)], rng)[:maximum]

    return mutate


class _Tried:
    """Callback of libFuzzer for each input; it never raises, so that the run continues after a finding."""

    def __init__(self, decoder: Decoder, folder: Path, shared: mmap.mmap) -> None:
        self._outcome = Outcome(decoder)
        self._folder = folder
        self._shared = shared

    def __call__(self, data: bytes) -> None:
        outcome, decoder = self._outcome, self._outcome.decoder
        if outcome.executions % _MEMORY_EVERY == 1:
            self._measure(data)
        else:
            spent_ms = timed_ms(outcome, data)
            if spent_ms > decoder.time_max_ms:
                spent_ms = min(spent_ms, *(timed_ms(outcome, data) for _ in range(_REPEATS)))
                if spent_ms > decoder.time_max_ms:
                    self._find("time", Finding(data, f"{spent_ms:.0f} ms", True))
            outcome.slowest_ms = max(outcome.slowest_ms, spent_ms)
        for place, finding in outcome.findings.items():
            self._find(place, finding)
        numbers = outcome.executions, outcome.refused, outcome.foreign, outcome.slowest_ms, outcome.memory_ratio
        _NUMBERS.pack_into(self._shared, 0, *numbers)

    def _measure(self, data: bytes) -> None:
        size = max(len(data), _MEMORY_LEAST_BYTES)
        ratio = measured_bytes(self._outcome, data) / size
        self._outcome.memory_ratio = max(self._outcome.memory_ratio, ratio)
        if ratio > self._outcome.decoder.memory_max:
            self._find("memory", Finding(data, f"{ratio:.1f} times {size} bytes", True))

    def _find(self, place: str, finding: Finding) -> None:
        """Record a finding, the first of each position."""
        path = self._folder / (hashlib.sha256(place.encode()).hexdigest()[:16] + ".json")
        if not path.exists():
            reported = {"data": finding.data.hex(), "error": finding.error, "excess": finding.is_excess}
            path.write_text(json.dumps({"place": place, **reported}))
