"""Loop that gives a decoder mutated inputs and records the results.

An input that runs new steps from line to line joins the corpus. Tracing slows a decoder down by a factor of ten or
more, so only one execution of ``_TRACE_EVERY`` is traced; ``guided.py`` does without it.
"""

from __future__ import annotations

import hashlib
import random
import signal
import sys
import time
import tracemalloc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Final

from tests.fuzzing.decoder import Decoder
from tests.fuzzing.mutation import mutated

__all__ = [
    "CORPUS",
    "Finding",
    "HangError",
    "Outcome",
    "corpus_of",
    "execute",
    "fuzz",
    "keep",
    "measured_bytes",
    "minimise",
    "timed_ms",
    "watched",
]

ROOT: Final = Path(__file__).resolve().parents[2]
CORPUS: Final = ROOT / "tests" / "corpus"
_PACKAGES: Final = tuple(str(ROOT / package) for package in ("gdp", "proxy", "fog", "gdp_extensions"))
_TRACE_EVERY: Final = 8
_MEMORY_EVERY: Final = 16
_MEMORY_LEAST_BYTES: Final = 4 << 10  # a shorter input counts as one of this length
_CORPUS_MAX: Final = 512
_KEPT_MAX_BYTES: Final = 4 << 10  # of a file that is added to the corpus
_KEPT_BYTES: Final = 24 << 10  # of all of one decoder; findings are kept next to it
_COVER: Final = "cover-"  # prefix of files that are kept for the lines they run, not because they once broke a decoder
_HANG_S: Final = 10.0  # processor time

_Step = tuple[str, int, int]  # file, line, the line that ran next in that frame


class HangError(BaseException):
    """Raised when a decoder took too much processor time."""


@contextmanager
def watched() -> Iterator[None]:
    """Make an ``execute`` that raises ``HangError`` after too long; its handler is set once, which costs 12 us."""
    before = signal.signal(signal.SIGPROF, _hang)
    try:
        yield
    finally:
        signal.signal(signal.SIGPROF, before)


@dataclass(frozen=True, slots=True)
class Finding:
    """Input for which a decoder raised a foreign error; ``is_excess``: or took too much time or memory."""

    data: bytes
    error: str
    is_excess: bool = False


@dataclass(slots=True)
class Outcome:
    """Results of one decoder.

    Attributes:
        findings: the first input of each kind of foreign exception.
        foreign: executions that raised a foreign exception.
        slowest_ms: processor time of one execution that was not traced.
        memory_ratio: most bytes held at a time by one execution, over the length of its input.
        found: inputs that ran new lines.
    """

    decoder: Decoder
    executions: int = 0
    refused: int = 0
    foreign: int = 0
    slowest_ms: float = 0.0
    memory_ratio: float = 0.0
    findings: dict[str, Finding] = field(default_factory=dict)
    found: list[bytes] = field(default_factory=list)


def corpus_of(decoder: Decoder) -> list[bytes]:
    """Return the seeds of a decoder and the content of its folder."""
    folder = CORPUS / decoder.name
    kept = [path.read_bytes() for path in sorted(folder.iterdir())] if folder.is_dir() else []
    return [*decoder.seeds, *kept]


def fuzz(decoder: Decoder, seconds: float, seed: int, executions_max: int | None = None) -> Outcome:
    """Give a decoder its corpus, then mutated inputs.

    Args:
        seconds: how long; the corpus is run in any case.
        executions_max: of mutated inputs; None: as many as there is time for.
    """
    rng = random.Random(f"{seed} {decoder.name}")
    outcome = Outcome(decoder)
    corpus = corpus_of(decoder)
    seen: set[_Step] = set()
    with watched():
        for data in corpus:
            _traced(outcome, data, seen)
        deadline_s = time.monotonic() + seconds
        while time.monotonic() < deadline_s and (executions_max is None or outcome.executions < executions_max):
            data = mutated(decoder, corpus, rng)
            if outcome.executions % _TRACE_EVERY == 0:
                if _traced(outcome, data, seen) and len(corpus) < _CORPUS_MAX:
                    corpus.append(data)
                    outcome.found.append(data)
            elif outcome.executions % _MEMORY_EVERY == 1:
                ratio = measured_bytes(outcome, data) / max(len(data), _MEMORY_LEAST_BYTES)
                outcome.memory_ratio = max(outcome.memory_ratio, ratio)
            else:
                outcome.slowest_ms = max(outcome.slowest_ms, timed_ms(outcome, data))
    return outcome


def keep(outcome: Outcome) -> list[Path]:
    """Write short inputs with lines that no other runs, and all findings, into the corpus; return the new files."""
    folder = CORPUS / outcome.decoder.name
    written = []
    for finding in outcome.findings.values():
        written += _write(folder / hashlib.sha256(finding.data).hexdigest()[:16], finding.data)
    held = sum(path.stat().st_size for path in _covers(outcome.decoder))
    for data in _adding(outcome.decoder, corpus_of(outcome.decoder), outcome.found):
        held += len(data)
        if held > _KEPT_BYTES:
            break
        written += _write(folder / (_COVER + hashlib.sha256(data).hexdigest()[:16]), data)
    return written


def minimise(decoder: Decoder) -> list[Path]:
    """Delete kept inputs whose lines shorter ones also run; return the deleted files.

    Inputs that once broke a decoder stay, and so do inputs older than this selection.
    """
    covers = {path.read_bytes(): path for path in _covers(decoder)}
    rest = [data for data in corpus_of(decoder) if data not in covers]
    needed = set(_adding(decoder, rest, list(covers)))
    gone = [path for data, path in covers.items() if data not in needed]
    for path in gone:
        path.unlink()
    return gone


def _covers(decoder: Decoder) -> list[Path]:
    return sorted((CORPUS / decoder.name).glob(_COVER + "*"))


def _write(path: Path, data: bytes) -> list[Path]:
    if path.exists():
        return []
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return [path]


def _adding(decoder: Decoder, corpus: Sequence[bytes], inputs: Sequence[bytes]) -> list[bytes]:
    """Return the short inputs, shortest first, with lines that neither the corpus nor a shorter one runs."""
    seen: set[_Step] = set()
    outcome = Outcome(decoder)
    short = sorted((data for data in inputs if len(data) <= _KEPT_MAX_BYTES), key=lambda data: (len(data), data))
    with watched():
        for data in corpus:
            _traced(outcome, data, seen)
        return [data for data in short if _traced(outcome, data, seen)]


def execute(outcome: Outcome, data: bytes) -> None:
    """Give the decoder one input and count the result; only while ``watched``."""
    outcome.executions += 1
    signal.setitimer(signal.ITIMER_PROF, _HANG_S)
    try:
        outcome.decoder.run(data)
    except outcome.decoder.allowed:
        outcome.refused += 1
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        outcome.foreign += 1
        outcome.findings.setdefault(_place(error), Finding(data, f"{type(error).__name__}: {error}"[:200]))
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _traced(outcome: Outcome, data: bytes, seen: set[_Step]) -> bool:
    """Execute; return whether new steps ran."""
    count = len(seen)

    def trace(frame: FrameType, event: str, arg: Any) -> Any:
        code = frame.f_code
        if not code.co_filename.startswith(_PACKAGES):
            return None
        before = 0

        def step(frame: FrameType, event: str, arg: Any) -> Any:
            nonlocal before
            if event == "line":
                seen.add((code.co_filename, before, frame.f_lineno))
                before = frame.f_lineno
            return step

        return step

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        execute(outcome, data)
    finally:
        sys.settrace(before)
    return len(seen) > count


def timed_ms(outcome: Outcome, data: bytes) -> float:
    """Execute; return the processor time that it took."""
    begun_s = time.thread_time()
    execute(outcome, data)
    return 1e3 * (time.thread_time() - begun_s)


def measured_bytes(outcome: Outcome, data: bytes) -> int:
    """Execute; return the most memory that was held at a time."""
    tracemalloc.start()
    try:
        execute(outcome, data)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def _hang(number: int, frame: FrameType | None) -> None:
    raise HangError(f"more than {_HANG_S:g} s")


def _place(error: BaseException) -> str:
    """Return the kind of an exception and its origin; both identify a finding."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = "" if trace is None else f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"
    return f"{type(error).__name__} {where}"
