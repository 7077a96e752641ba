"""Assembler for eBPF: named registers, named labels, one method per instruction.

Sans-I/O; numbers in, bytes out.
Source: RFC 9669 (BPF Instruction Set Architecture). One instruction is 8 bytes. A jump counts instructions from the one
after it::

    opcode (1)  source and destination register (1)  offset (2, signed)  immediate (4, signed)
"""

from __future__ import annotations

import struct
import sys
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from gdp.errors import LocalError


class Reg(IntEnum):
    """R0: results; R1 to R5: arguments, lost in a call; R6 to R9: preserved; R10: the top of the stack, read only."""

    R0 = 0
    R1 = 1
    R2 = 2
    R3 = 3
    R4 = 4
    R5 = 5
    R6 = 6
    R7 = 7
    R8 = 8
    R9 = 9
    R10 = 10


_SIZES: Final = {1: 0x10, 2: 0x08, 4: 0x00, 8: 0x18}
_LOAD, _STORE_VALUE, _STORE, _IN_MEMORY = 0x01, 0x02, 0x03, 0x60
_ALU32, _ALU64, _JUMP, _FROM_REGISTER = 0x04, 0x07, 0x05, 0x08
_ADD, _SUBTRACT, _DIVIDE, _OR, _AND = 0x00, 0x10, 0x30, 0x40, 0x50
_SHIFT_LEFT, _SHIFT_RIGHT, _EXCLUSIVE_OR, _MOVE = 0x60, 0x70, 0xA0, 0xB0
_CONDITIONS: Final = {"==": 0x10, ">": 0x20, ">=": 0x30, "&": 0x40, "!=": 0x50, "<": 0xA0, "<=": 0xB0}
_CALL, _EXIT, _WIDE, _BIG_ENDIAN = 0x85, 0x95, 0x18, 0xDC
_MAP: Final = 1  # BPF_PSEUDO_MAP_FD
_SUBPROGRAM: Final = 1  # BPF_PSEUDO_CALL


@dataclass(frozen=True, slots=True, kw_only=True)
class _Step:
    opcode: int
    destination: int = 0
    source: int = 0
    offset: int = 0
    value: int = 0
    label: str = ""


class Assembler:
    """A program as instructions in order. Values are signed 32-bit, comparisons unsigned 64-bit."""

    def __init__(self) -> None:
        self._steps: list[_Step] = []
        self._labels: dict[str, int] = {}

    def label(self, name: str) -> None:
        """Name the next instruction. Raises ``LocalError``: the label exists already."""
        if name in self._labels:
            raise LocalError(f"label {name} stands twice")
        self._labels[name] = len(self._steps)

    def move(self, to: Reg, value: Reg | int) -> None:
        """Set ``to`` to a value."""
        self._compute(_MOVE, to, value)

    def add(self, to: Reg, value: Reg | int) -> None:
        """Add a value to ``to``, modulo 2**64."""
        self._compute(_ADD, to, value)

    def subtract(self, to: Reg, value: Reg | int) -> None:
        """Subtract a value from ``to``, modulo 2**64."""
        self._compute(_SUBTRACT, to, value)

    def divide(self, to: Reg, value: int) -> None:
        """Divide ``to`` by a value."""
        self._compute(_DIVIDE, to, value)

    def mask(self, to: Reg, bits: Reg | int) -> None:
        """Clear all bits of ``to`` but these."""
        self._compute(_AND, to, bits)

    def include(self, to: Reg, bits: Reg | int) -> None:
        """Set these bits of ``to``."""
        self._compute(_OR, to, bits)

    def exclusive_or(self, to: Reg, bits: Reg | int) -> None:
        """Invert these bits of ``to``."""
        self._compute(_EXCLUSIVE_OR, to, bits)

    def shift_left(self, to: Reg, bits: int) -> None:
        """Shift ``to`` left by ``bits``."""
        self._compute(_SHIFT_LEFT, to, bits)

    def shift_right(self, to: Reg, bits: int) -> None:
        """Shift ``to`` right by ``bits``."""
        self._compute(_SHIFT_RIGHT, to, bits)

    def add_word(self, to: Reg, value: Reg | int) -> None:
        """Add a value to ``to``, modulo 2**32."""
        self._compute(_ADD, to, value, _ALU32)

    def move_word(self, to: Reg, value: Reg | int) -> None:
        """Set ``to`` to the low 32 bits of a value."""
        self._compute(_MOVE, to, value, _ALU32)

    def shift_word_right(self, to: Reg, bits: int) -> None:
        """Shift the low 32 bits of ``to`` right by ``bits``; the others are lost."""
        self._compute(_SHIFT_RIGHT, to, bits, _ALU32)

    def from_big_endian(self, to: Reg, bits: int) -> None:
        """Convert a big-endian value that was loaded from a frame into a number."""
        self._steps.append(_Step(opcode=_BIG_ENDIAN, destination=to, value=bits))

    def load(self, to: Reg, base: Reg, offset: int, size: int) -> None:
        """Read ``size`` bytes at ``base + offset``."""
        self._steps.append(_Step(opcode=_LOAD | _IN_MEMORY | _SIZES[size], destination=to, source=base, offset=offset))

    def store(self, base: Reg, offset: int, value: Reg | int, size: int) -> None:
        """Write ``size`` bytes at ``base + offset``."""
        if isinstance(value, Reg):
            self._steps.append(
                _Step(opcode=_STORE | _IN_MEMORY | _SIZES[size], destination=base, source=value, offset=offset)
            )
        else:
            self._steps.append(
                _Step(
                    opcode=_STORE_VALUE | _IN_MEMORY | _SIZES[size],
                    destination=base,
                    source=0,
                    offset=offset,
                    value=value,
                )
            )

    def load_map(self, to: Reg, descriptor: int) -> None:
        """Load a map as an argument of the next call."""
        self._steps += [_Step(opcode=_WIDE, destination=to, source=_MAP, value=descriptor), _Step(opcode=0)]

    def jump(self, label: str) -> None:
        """Jump forward to a label."""
        self._steps.append(_Step(opcode=_JUMP, label=label))

    def jump_if(self, left: Reg, condition: str, right: Reg | int, label: str) -> None:
        """Jump to a label if ``left condition right``; ``&`` tests for a common bit."""
        opcode = _JUMP | _CONDITIONS[condition]
        if isinstance(right, Reg):
            self._steps.append(_Step(opcode=opcode | _FROM_REGISTER, destination=left, source=right, label=label))
        else:
            self._steps.append(_Step(opcode=opcode, destination=left, value=right, label=label))

    def call(self, helper: int) -> None:
        """Call a helper of the kernel; R1 to R5 are lost."""
        self._steps.append(_Step(opcode=_CALL, value=helper))

    def call_label(self, label: str) -> None:
        """Call a subprogram, which has a stack of its own; R1 to R5 are lost."""
        self._steps.append(_Step(opcode=_CALL, source=_SUBPROGRAM, label=label))

    def leave(self, result: int | None = None) -> None:
        """End the program with a result, or with the value of R0."""
        if result is not None:
            self.move(Reg.R0, result)
        self._steps.append(_Step(opcode=_EXIT))

    def assemble(self) -> bytes:
        """Return the program in host byte order.

        Raises:
            LocalError: a jump has no target, or a number does not fit.
        """
        return b"".join(self._encoded(at, step) for at, step in enumerate(self._steps))

    def _compute(self, operation: int, to: Reg, value: Reg | int, width: int = _ALU64) -> None:
        if isinstance(value, Reg):
            self._steps.append(_Step(opcode=width | operation | _FROM_REGISTER, destination=to, source=value))
        else:
            self._steps.append(_Step(opcode=width | operation, destination=to, value=value))

    def _encoded(self, at: int, step: _Step) -> bytes:
        offset, value = step.offset, step.value
        if step.label:
            if step.label not in self._labels:
                raise LocalError(f"no label {step.label}")
            distance = self._labels[step.label] - at - 1
            offset, value = (offset, distance) if step.opcode == _CALL else (distance, value)
        little = sys.byteorder == "little"
        registers = step.destination | step.source << 4 if little else step.destination << 4 | step.source
        try:
            return struct.pack("=BBhi", step.opcode, registers, offset, value)
        except struct.error as error:
            raise LocalError(f"instruction {at}: {error}") from error
