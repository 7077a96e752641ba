"""Amplification: bytes that the network sends because of the bytes of one member, or of a stranger on a link.

One process for each row: the stage of the insiders (``tests/insiders/stage.py``) on the in-memory network with a
virtual clock. Statements and frames of every kind look honest and are signed by real keys. The speaker of a row sends
nothing, sends at the rate that its grants pay, and at five and ten times that rate.

- *In* are the speaker's bytes. *Out* are the additional bytes of all other machines, compared with a run without the
  speaker. They include answers, copies on the way and later repetitions. Frames that a data plane forwards by its
  table do not count.
- *Plain* is out by in at the first rate.
- *Beyond* is the difference of out by that of in between the last two rates: bytes that no grant pays. Many statements
  are refused for their content, so the grants are not used up at the first rate; at five times it they are.
- For a stranger everything counts, and *towards* are the bytes sent into its link.

Rates and bursts of the grants are made smaller for this (``GRANTS``), so that the first rate is the same for every
kind. The response to a byte beyond them does not depend on their size.

Rows of earlier runs stay in the file until they are measured again.

    .venv/bin/python scripts/bench/security.py amplification
    .venv/bin/python scripts/bench/security.py amplification --speakers proxy --kinds withdraw query --no-save
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import random
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final
from unittest import mock

from report import print_table, progress

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from gdp.control.boundary import ErrorBoundary
from gdp.frame.codec import ETHER_BYTES
from tests.insiders.forge import KINDS_OF_WORDS, Forge
from tests.insiders.network import TracingNetwork
from tests.insiders.stage import PERSONAS, Persona, Stage
from tests.insiders.trial import prepared

__all__ = ["add_arguments", "run"]

GOAL_STRANGER: Final = 1.0
GOAL_BEYOND: Final = 3.0
SPEAKERS: Final = {
    "proxy": "nuc1/insider",
    "proxy, another domain": "nuc4/alien",
    "switch": "evil",
    "RIB": "evil/rib2",
    "stranger": "x1",
    "stranger, recorded": "x1",
}
_STRANGERS: Final = ("stranger", "stranger, recorded")
_PER_S: Final = 20.0  # rate and burst that a grant pays here
_GRANTS: Final[tuple[tuple[str, float], ...]] = (
    ("gdp.switch.name_resolver.QUESTIONS_PER_S", _PER_S),
    ("gdp.switch.name_resolver.QUESTIONS_BURST", _PER_S),
    ("gdp.switch.name_resolver.SWITCH_QUESTIONS_PER_S", _PER_S),
    ("gdp.switch.name_resolver.SWITCH_QUESTIONS_BURST", _PER_S),
    ("gdp.switch.core.JOINS_PER_S", _PER_S),
    ("gdp.switch.core.JOINS_BURST", _PER_S),
    ("gdp.switch.core.ADVERTISEMENTS_PER_S", _PER_S),
    ("gdp.switch.core.ADVERTISEMENTS_BURST", _PER_S),
    ("gdp.switch.flooding.LINK_STATES_PER_S", _PER_S),
    ("gdp.switch.flooding.LINK_STATES_BURST", _PER_S),
    ("gdp.rib.core.ANSWER_BYTES_PER_S", _PER_S * 2_048),
    ("gdp.rib.core.ANSWER_BYTES_BURST", _PER_S * 2_048),
    ("gdp.trust.revocations._OWNERS_PER_S", _PER_S),
    ("gdp.trust.revocations._OWNERS_BURST", _PER_S),
    ("gdp.trust.revocations._ISSUER_PER_S", _PER_S),
    ("gdp.trust.revocations._ISSUER_BURST", _PER_S),
)
_RATES: Final = 1, 5, 10  # multiples of what a grant pays
_TAIL_S: Final = 3.0
_RECORDED: Final = "recorded"


@dataclass(frozen=True, slots=True)
class Meter:
    """Bytes of one run.

    Args:
        said: by the speaker.
        sent: by all other machines.
        towards: of these, into the speaker's links.
    """

    said: int
    sent: int
    towards: int


@dataclass(frozen=True, slots=True)
class Row:
    """Amplification of one speaker by one kind of statement; ratios are None where too little was sent."""

    speaker: str
    kind: str
    said: int
    plain: float | None
    beyond: float | None
    towards: float | None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this subcommand."""
    parser.add_argument("--speakers", nargs="+", choices=list(SPEAKERS), default=list(SPEAKERS))
    parser.add_argument("--kinds", nargs="+", choices=KINDS_OF_WORDS, default=list(KINDS_OF_WORDS))
    parser.add_argument("--seconds", type=float, default=4.0, help="of virtual time, spoken (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)


def run(options: argparse.Namespace, held: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    """Measure every speaker with every kind."""
    logging.disable(logging.CRITICAL)
    ErrorBoundary.reraises = True
    measured = list(_measured(options))
    before = [Row(**row) for row in held.get("rows", [])]
    new = {(row.speaker, row.kind) for row in measured}
    rows = [*(row for row in before if (row.speaker, row.kind) not in new), *measured]
    lines = []
    for row in sorted(rows, key=lambda each: (each.speaker, -_decisive(each))):
        figures = (_text(row.plain), _text(row.beyond), _text(row.towards))
        lines.append((row.speaker, row.kind, f"{row.said:,}", *figures, "yes" if _is_met(row) else "NO"))
    head = ("speaker", "kind", "said, bytes", "plain", "beyond its grants", "towards it", "met")
    print_table(head, lines, title="Bytes drawn for each byte said", words=2)
    members = max((_decisive(row) for row in rows if row.speaker not in _STRANGERS), default=0.0)
    strangers = max((_decisive(row) for row in rows if row.speaker in _STRANGERS), default=0.0)
    progress(f"members, beyond their grants: {members:.2f}, at most {GOAL_BEYOND}")
    progress(f"strangers: {strangers:.2f}, at most {GOAL_STRANGER}")
    found: dict[str, Any] = {
        "members_beyond": members, "strangers": strangers, "target_members": GOAL_BEYOND,
        "target_strangers": GOAL_STRANGER, "rows": [asdict(row) for row in rows],
    }  # fmt: skip
    return found, all(map(_is_met, rows))


def _decisive(row: Row) -> float:
    ratios = (row.plain, row.beyond, row.towards) if row.speaker in _STRANGERS else (row.beyond,)
    return max((ratio for ratio in ratios if ratio is not None), default=0.0)


def _is_met(row: Row) -> bool:
    return _decisive(row) <= (GOAL_STRANGER if row.speaker in _STRANGERS else GOAL_BEYOND)


def _text(ratio: float | None) -> str:
    return "" if ratio is None else f"{ratio:.2f}"


@contextmanager
def _smaller_grants() -> Iterator[None]:
    with ExitStack() as stack:
        for where, value in _GRANTS:
            stack.enter_context(mock.patch(where, value))
        yield


def _measured(options: argparse.Namespace) -> Iterator[Row]:
    """Measure each row in processes that begin as copies of one settled stage."""
    global _stage, _record  # noqa: PLW0603 - what the processes begin with
    jobs = [
        (speaker, kind, times)
        for speaker in options.speakers
        for kind in ((_RECORDED,) if speaker == "stranger, recorded" else options.kinds)
        for times in _RATES
    ]
    jobs += [(speaker, "", 0) for speaker in options.speakers]
    with prepared(), _smaller_grants():
        _stage = Stage(options.seed)
        _record = _recorded(_stage)
        with multiprocessing.get_context("fork").Pool(options.processes, maxtasksperchild=1) as pool:
            under_way = {job: pool.apply_async(_spoken, (*job, options.seconds)) for job in jobs}
            silent = {speaker: under_way.pop((speaker, "", 0)) for speaker in options.speakers}
            for speaker, kind, times in list(under_way):
                if times == 1:
                    progress(f"{speaker}: {kind}")
                    meters = (under_way[speaker, kind, each].get() for each in _RATES)
                    yield _row(speaker, kind, silent[speaker].get(), *meters)


def _row(speaker: str, kind: str, silent: Meter, once: Meter, paid: Meter, often: Meter) -> Row:
    def ratio(drawn: int, said: int) -> float | None:
        return drawn / said if said > 0 else None

    return Row(
        speaker, kind, often.said,
        ratio(once.sent - silent.sent, once.said),
        ratio(often.sent - paid.sent, often.said - paid.said),
        ratio(often.towards - silent.towards, often.said),
    )  # fmt: skip


_stage: Stage
_record: list[bytes]


def _recorded(stage: Stage) -> list[bytes]:
    """Return what the links of nuc2 carried in ten seconds."""
    frames: list[bytes] = []
    network = stage.world.network

    def tap(_at_s: float, a: str, b: str, frame: bytes) -> None:
        if "nuc2" in (a, b):
            frames.append(frame[ETHER_BYTES:])

    network.taps.append(tap)
    for number in range(20):
        stage.flow.publish(b"recorded %d" % number)
        network.run(0.5)
    network.taps.remove(tap)
    return frames


def _spoken(speaker: str, kind: str, times: int, seconds: float) -> Meter:
    """Send statements of a kind from one speaker, in a copy of the stage; count the bytes sent."""
    stage, network = _stage, _stage.world.network
    assert isinstance(network, TracingNetwork)
    persona = next(each for each in PERSONAS if each.node == SPEAKERS[speaker])
    sent: Counter[str] = Counter()
    towards = said = 0

    def tap(_at_s: float, a: str, b: str, frame: bytes) -> None:
        nonlocal towards
        if network._is_machine and a != persona.node:
            sent[a] += len(frame) - ETHER_BYTES
            towards += (len(frame) - ETHER_BYTES) if b == persona.node else 0

    network.taps.append(tap)
    rng, forge = random.Random(f"{speaker} {kind}"), Forge(stage)
    step_s = seconds if times == 0 else 1 / (times * _PER_S)
    for _ in range(round(seconds / step_s)):
        if times:
            said += _say(stage, forge, rng, persona, kind)
        network.run(step_s)
    network.run(_TAIL_S)
    return Meter(said, sum(sent.values()), towards)


def _say(stage: Stage, forge: Forge, rng: random.Random, persona: Persona, kind: str) -> int:
    """Send one statement; return its bytes."""
    is_stranger = persona.node == SPEAKERS["stranger"]
    places = [each for each in stage.places(persona.node) if stage.believes(persona, each) is not is_stranger]
    place = rng.choice(places)
    if kind == _RECORDED:
        frames: tuple[bytes, ...] = (rng.choice(_record),)
    else:
        utterance = forge.say(rng, persona, kind, place)
        if utterance is None:
            return 0
        frames = utterance.frames
    for frame in frames:
        stage.world.network.inject(place.node, place.port, frame, place.mac)
    return sum(map(len, frames))
