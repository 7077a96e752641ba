"""Assembler: its instructions compared with RFC 9669, and its listings in ``bpf_asm`` style."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest

from gdp.errors import LocalError
from gdp.ports.kernel.assembler import Assembler, Reg

R0, R1, R2, R10 = Reg.R0, Reg.R1, Reg.R2, Reg.R10

pytestmark = pytest.mark.skipif(sys.byteorder == "big", reason="the vectors are little-endian")


@pytest.mark.parametrize(
    ("write", "expected"),
    [
        (lambda a: a.move(R1, R2), "bf21000000000000"),
        (lambda a: a.move(R1, -2), "b7010000feffffff"),
        (lambda a: a.add(R2, 110), "070200006e000000"),
        (lambda a: a.add(R2, R1), "0f12000000000000"),
        (lambda a: a.subtract(R2, 1), "1702000001000000"),
        (lambda a: a.shift_left(R2, 4), "6702000004000000"),
        (lambda a: a.mask(R2, 0x7F), "570200007f000000"),
        (lambda a: a.exclusive_or(R2, 1), "a702000001000000"),
        (lambda a: a.from_big_endian(R2, 16), "dc02000010000000"),
        (lambda a: a.load(R2, R1, 76, 4), "61124c0000000000"),
        (lambda a: a.load(R2, R1, 17, 1), "7112110000000000"),
        (lambda a: a.load(R2, R1, 20, 2), "6912140000000000"),
        (lambda a: a.load(R2, R10, -8, 8), "79a2f8ff00000000"),
        (lambda a: a.store(R10, -8, R1, 8), "7b1af8ff00000000"),
        (lambda a: a.store(R10, -4, 7, 4), "620afcff07000000"),
        (lambda a: a.load_map(R1, 5), "18110000050000000000000000000000"),
        (lambda a: a.call(23), "8500000017000000"),
        (lambda a: a.leave(), "9500000000000000"),
        (lambda a: a.leave(2), "b700000002000000" + "9500000000000000"),
    ],
)
def test_an_instruction_is_the_bytes_of_the_standard(write: Callable[[Assembler], None], expected: str) -> None:
    written = Assembler()
    write(written)
    assert written.assemble().hex() == expected


@pytest.mark.parametrize(
    ("condition", "opcode"),
    [("==", 0x15), (">", 0x25), (">=", 0x35), ("&", 0x45), ("!=", 0x55), ("<", 0xA5), ("<=", 0xB5)],
)
def test_a_comparison_has_its_own_opcode(condition: str, opcode: int) -> None:
    written = Assembler()
    written.jump_if(R1, condition, 3, "here")
    written.jump_if(R1, condition, R2, "here")
    written.label("here")
    assert written.assemble() == bytes([opcode, 1, 1, 0, 3, 0, 0, 0, opcode | 8, 0x21, 0, 0, 0, 0, 0, 0])


def test_a_jump_counts_from_the_next_instruction_either_way() -> None:
    written = Assembler()
    written.label("back")
    written.move(R0, 0)
    written.jump("on")
    written.jump("back")
    written.label("on")
    written.leave()
    assert written.assemble()[8:24].hex() == "05000100" + "00000000" + "0500fdff" + "00000000"


def test_a_map_counts_as_two_instructions() -> None:
    written = Assembler()
    written.jump("on")
    written.load_map(R1, 5)
    written.label("on")
    written.leave()
    assert written.assemble()[:4].hex() == "05000200"


def test_a_jump_to_nowhere_is_refused() -> None:
    written = Assembler()
    written.jump("nowhere")
    with pytest.raises(LocalError, match="no label nowhere"):
        written.assemble()


def test_a_label_given_twice_is_refused() -> None:
    written = Assembler()
    written.label("here")
    with pytest.raises(LocalError, match="twice"):
        written.label("here")


def test_a_number_that_does_not_fit_is_refused() -> None:
    written = Assembler()
    written.move(R0, 1 << 31)
    with pytest.raises(LocalError, match="instruction 0"):
        written.assemble()
