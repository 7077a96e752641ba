"""The loop that gives a decoder mutated inputs, and what came of it.

An input that runs steps from line to line that none before it ran joins the corpus. Tracing slows a decoder down by a
factor of ten or more, so it gets a tenth of the time; ``guided.py`` does without that.
"""

from __future__ import annotations

import hashlib
import random
import signal
import sys
import time
import tracemalloc
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Final

from tests.fuzzing.decoder import Decoder
from tests.fuzzing.mutation import mutated

__all__ = ["CORPUS", "Finding", "HangError", "Outcome", "Watchdog", "corpus_of", "execute", "fuzz", "keep", "minimise"]

ROOT: Final = Path(__file__).resolve().parents[2]
CORPUS: Final = ROOT / "tests" / "corpus"
_ROOMS: Final = tuple(str(ROOT / room) for room in ("gdp", "proxy", "fog"))
_TRACED_SHARE: Final = 0.1  # of the time
_MEMORY_EVERY: Final = 16
_MEMORY_LEAST_BYTES: Final = 4 << 10  # a shorter input counts as one of this length
_CORPUS_MAX: Final = 512
_KEPT_MAX_BYTES: Final = 4 << 10  # of a file that is added to the corpus
_KEPT_BYTES: Final = 24 << 10  # of all of one decoder; findings are kept beside
_COVER: Final = "cover-"  # how names of files begin that are kept for what they run, not because they once broke
_HANG_S: Final = 10.0  # processor time
_REARM_S: Final = 1.0

_Step = tuple[str, int, int]  # file, line, the line that ran next in that frame


class HangError(BaseException):
    """A decoder took too much processor time."""


class Watchdog:
    """Raises ``HangError`` in an execution that takes some 9 to 10 s of processor time, while it is entered.

    To set a signal's handler and a timer for each execution would cost more than most executions do.
    """

    def __enter__(self) -> Watchdog:
        self._before = signal.signal(signal.SIGPROF, _hang)
        self._armed_s = 0.0
        self.look(time.monotonic())
        return self

    def look(self, now_s: float) -> None:
        """Begin anew with the time that is left, once a second; called between executions."""
        if now_s >= self._armed_s + _REARM_S:
            signal.setitimer(signal.ITIMER_PROF, _HANG_S)
            self._armed_s = now_s

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, self._before)


@dataclass(frozen=True, slots=True)
class Finding:
    """An input for which a decoder raised what it may not; ``is_excess``: or took too much time or memory."""

    data: bytes
    error: str
    is_excess: bool = False


@dataclass(slots=True)
class Outcome:
    """What became of one decoder.

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
    """Return the seeds of a decoder, and what its folder holds."""
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
    with Watchdog() as watchdog:
        for data in corpus:
            watchdog.look(time.monotonic())
            _traced(outcome, data, seen)
        begun_s = now_s = time.monotonic()
        traced_s = 0.0
        while now_s < begun_s + seconds and (executions_max is None or outcome.executions < executions_max):
            watchdog.look(now_s)
            data = mutated(decoder, corpus, rng)
            if traced_s <= _TRACED_SHARE * (now_s - begun_s):
                if _traced(outcome, data, seen) and len(corpus) < _CORPUS_MAX:
                    corpus.append(data)
                    outcome.found.append(data)
                traced_s += time.monotonic() - now_s
            elif outcome.executions % _MEMORY_EVERY == 1:
                _measured(outcome, data)
            else:
                spent_s = -time.thread_time()
                execute(outcome, data)
                spent_s += time.thread_time()
                outcome.slowest_ms = max(outcome.slowest_ms, 1e3 * spent_s)
            now_s = time.monotonic()
    return outcome


def keep(outcome: Outcome) -> list[Path]:
    """Write short inputs that run what no other runs, and all findings, into the corpus; return the new files."""
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
    """Delete kept inputs that run nothing which shorter ones do not run; return the files that went.

    What once broke a decoder stays, and so does what came before inputs were kept for what they run.
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
    """Return those short inputs, shortest first, that run what neither the corpus nor a shorter one runs."""
    seen: set[_Step] = set()
    outcome = Outcome(decoder)
    for data in corpus:
        _traced(outcome, data, seen)
    short = sorted((data for data in inputs if len(data) <= _KEPT_MAX_BYTES), key=lambda data: (len(data), data))
    return [data for data in short if _traced(outcome, data, seen)]


def execute(outcome: Outcome, data: bytes) -> None:
    """Give the decoder one input, and count what came of it."""
    outcome.executions += 1
    try:
        outcome.decoder.run(data)
    except outcome.decoder.allowed:
        outcome.refused += 1
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        outcome.foreign += 1
        outcome.findings.setdefault(_place(error), Finding(data, f"{type(error).__name__}: {error}"[:200]))


def _traced(outcome: Outcome, data: bytes, seen: set[_Step]) -> bool:
    """Execute; return whether that ran steps that were not seen before."""
    count = len(seen)

    def trace(frame: FrameType, event: str, arg: Any) -> Any:
        code = frame.f_code
        if not code.co_filename.startswith(_ROOMS):
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


def _measured(outcome: Outcome, data: bytes) -> None:
    tracemalloc.start()
    try:
        execute(outcome, data)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    outcome.memory_ratio = max(outcome.memory_ratio, peak / max(len(data), _MEMORY_LEAST_BYTES))


def _hang(number: int, frame: FrameType | None) -> None:
    raise HangError(f"more than {_HANG_S:g} s")


def _place(error: BaseException) -> str:
    """Return the kind of an exception and where it was raised, which tells findings apart."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = "" if trace is None else f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"
    return f"{type(error).__name__} {where}"
