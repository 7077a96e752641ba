"""SHA-256 as instructions of eBPF: one subprogram that takes a block into a state.

Sans-I/O; nothing in, instructions out. Source: FIPS 180-4, sections 4.1.2 and 6.2.2. The kernel offers no digest to a
program of this kind. All rounds stand one after another: 3,700 instructions, about a microsecond for a block.

A rotation takes the low half of a shift of a word that stands in both halves of a register::

    rotr(x, 6) ^ rotr(x, 11) ^ rotr(x, 25)  =  low half of (((d >> 14) ^ d) >> 5 ^ d) >> 6,  d = x << 32 | x
"""

from __future__ import annotations

from typing import Final

from gdp.ports.kernel.assembler import Assembler, Reg

BLOCK_BYTES: Final = 64
STATE_BYTES: Final = 32
_ROUNDS: Final = 64
_WORDS: Final = 16  # of the schedule that are kept
_SCHEDULE: Final = -4 * _WORDS  # on the stack of the subprogram
_STATE: Final = _SCHEDULE - 8
_FREE: Final = (Reg.R0, Reg.R1)
_WORKING: Final = (Reg.R2, Reg.R3, Reg.R4, Reg.R5, Reg.R6, Reg.R7, Reg.R8, Reg.R9)  # a to h before the first round


def _primes(count: int) -> list[int]:
    found: list[int] = []
    number = 2
    while len(found) < count:
        if all(number % each for each in found):
            found.append(number)
        number += 1
    return found


def _fraction(number: int, root: int) -> int:
    """Return the first 32 bits of the fraction of a square or cubic root."""
    scaled, low, high = number << (32 * root), 0, number << 32
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if middle**root <= scaled else (low, middle)
    return low & 0xFFFF_FFFF


_CONSTANTS: Final = tuple(_fraction(each, 3) for each in _primes(_ROUNDS))
FIRST_STATE: Final = tuple(_fraction(each, 2) for each in _primes(8))


def _signed(word: int) -> int:
    return word - (1 << 32) if word >> 31 else word


def add_compress(to: Assembler, label: str) -> None:
    """Add the subprogram: R1 points to a state of eight words in host order, R2 to a block; R0 is 0 afterwards."""
    one, two = _FREE
    to.label(label)
    to.store(Reg.R10, _STATE, Reg.R1, 8)
    for word in range(_WORDS):
        to.load(Reg.R0, Reg.R2, 4 * word, 4)
        to.from_big_endian(Reg.R0, 32)
        to.store(Reg.R10, _SCHEDULE + 4 * word, Reg.R0, 4)
    for word, each in enumerate(_WORKING):
        to.load(each, Reg.R1, 4 * word, 4)
    working = list(_WORKING)
    for turn in range(_ROUNDS):
        a, b, c, d, e, f, g, h = working
        if turn >= _WORDS:
            _extend(to, turn)
        else:
            to.load(one, Reg.R10, _word(turn), 4)
        to.add_word(h, one)
        to.add_word(h, _signed(_CONSTANTS[turn]))
        _rotations(to, e, (6, 11, 25))
        to.add_word(h, two)
        to.move(one, f)  # the choice by e
        to.exclusive_or(one, g)
        to.mask(one, e)
        to.exclusive_or(one, g)
        to.add_word(h, one)
        to.add_word(d, h)
        _rotations(to, a, (2, 13, 22))
        to.add_word(h, two)
        to.move(one, a)  # the majority
        to.exclusive_or(one, b)
        to.mask(one, c)
        to.move(two, a)
        to.mask(two, b)
        to.exclusive_or(one, two)
        to.add_word(h, one)
        working = [h, a, b, c, d, e, f, g]
    to.load(one, Reg.R10, _STATE, 8)
    # after 64 rounds each word is in its first register again
    for word, each in enumerate(_WORKING):
        to.load(two, one, 4 * word, 4)
        to.add_word(two, each)
        to.store(one, 4 * word, two, 4)
    to.leave(0)


def _word(turn: int) -> int:
    return _SCHEDULE + 4 * (turn % _WORDS)


def _double(to: Assembler, source: Reg, into: Reg) -> None:
    to.move(into, source)
    to.shift_left(into, 32)
    to.include(into, source)


def _rotations(to: Assembler, source: Reg, bits: tuple[int, int, int]) -> None:
    """Set the second free register to the sum of three rotations, modulo 2."""
    one, two = _FREE
    least, middle, most = bits
    _double(to, source, one)
    to.move(two, one)
    to.shift_right(two, most - middle)
    to.exclusive_or(two, one)
    to.shift_right(two, middle - least)
    to.exclusive_or(two, one)
    to.shift_right(two, least)


def _extend(to: Assembler, turn: int) -> None:
    """Set the first free register, and its place in the schedule, to the word of a round."""
    one, two = _FREE
    place = _word(turn)
    _sigma(to, turn - 15, (7, 18, 3))
    for before in (16, 7):
        to.load(two, Reg.R10, _word(turn - before), 4)
        to.add_word(one, two)
    to.store(Reg.R10, place, one, 4)
    _sigma(to, turn - 2, (17, 19, 10))
    to.load(two, Reg.R10, place, 4)
    to.add_word(one, two)
    to.store(Reg.R10, place, one, 4)


def _sigma(to: Assembler, turn: int, bits: tuple[int, int, int]) -> None:
    """Set the first free register to two rotations and a shift of a word of the schedule."""
    one, two = _FREE
    least, most, shift = bits
    to.load(one, Reg.R10, _word(turn), 4)
    _double(to, one, two)
    to.move(one, two)
    to.shift_right(one, most - least)
    to.exclusive_or(one, two)
    to.shift_right(one, least)
    to.shift_word_right(two, shift)
    to.exclusive_or(one, two)
    to.move_word(one, one)
