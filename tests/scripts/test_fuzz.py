"""Fuzzer, and each decoder for a fraction of a second."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

import fuzz as script
from tests.fuzzing.decoder import Decoder
from tests.fuzzing.registry import DECODERS
from tests.fuzzing.runner import corpus_of, fuzz

EXECUTIONS = 60  # of mutated inputs for each decoder


@pytest.fixture(autouse=True)
def _logs() -> Iterator[None]:
    """Log again, as the script does not."""
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("decoder", DECODERS, ids=lambda decoder: decoder.name)
def test_a_decoder_returns_or_raises_an_error_of_its_own(decoder: Decoder) -> None:
    outcome = fuzz(decoder, 0.2, 1, EXECUTIONS)
    assert {place: finding.error for place, finding in outcome.findings.items()} == {}


def test_every_decoder_has_a_name_of_its_own_and_an_input() -> None:
    names = [decoder.name for decoder in DECODERS]
    assert len(set(names)) == len(names)
    assert all(corpus_of(decoder) for decoder in DECODERS)


def test_a_foreign_exception_is_found_and_identified_by_its_position() -> None:
    def bad(data: bytes) -> object:
        if b"x" in data:
            return data[1_000_000]
        raise ValueError("refused")

    outcome = fuzz(Decoder("bad", bad, (b"xyz",), (ValueError,)), 5.0, 1, 200)
    (finding,) = outcome.findings.values()
    assert finding.error.startswith("IndexError")
    assert 0 < outcome.foreign < outcome.executions == outcome.foreign + outcome.refused


def test_the_same_seed_gives_the_same_inputs() -> None:
    taken: list[list[bytes]] = [[], []]
    for inputs in taken:
        fuzz(Decoder("same", inputs.append, (b"seed", b"other"), ()), 5.0, 3, 100)
    assert taken[0] == taken[1]


def test_the_script_lists_its_decoders_and_refuses_unknown_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert script.main(["--list"]) == 0
    assert "msg " in capsys.readouterr().out
    assert script.main(["--only", "nonsense"]) == 2


def test_the_script_ends_with_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert script.main(["--only", "frame,msg", "--seconds", "0.1"]) == 0
    assert "2 decoders, 0 with a foreign exception" in capsys.readouterr().out
    with pytest.raises(SystemExit) as left:
        script.main(["--help"])
    assert not left.value.code
    assert "Examples" in capsys.readouterr().out
