"""Hardware requirements, independent of providers (``cpu:16``, ``T4``, ``gpu:A100:2``, ``cpu:4,mem:16``), and offers.

Sans-I/O.
"""

from __future__ import annotations

import re
from dataclasses import KW_ONLY, dataclass
from typing import Final

from gdp.errors import LocalError

GPUS: Final = ("T4", "L4", "A10G", "V100", "A100", "H100", "K80", "P100", "P4", "L40S")
HOURS_A_MONTH: Final = 730.0  # 365 days of 24 hours, over 12
_FORM: Final = "cpu:N, mem:GiB, a GPU such as T4, or gpu:T4:2; several with commas between"


@dataclass(frozen=True, slots=True)
class Hardware:
    """Minimum hardware.

    Args:
        cpus: virtual CPUs; 0: any number.
        memory_gib: 0: any amount.
        gpu: model as in ``GPUS``; empty: none required.
            gpus: number of GPUs.
    """

    cpus: int = 0
    memory_gib: float = 0.0
    gpu: str = ""
    gpus: int = 0

    @classmethod
    def from_text(cls, text: str) -> Hardware:
        """Parse the textual form.

        Raises:
            LocalError: the form is wrong, or a key occurs twice; the text states the expected form.
        """
        found: dict[str, float] = {}
        gpu = ""
        for word in (part.strip() for part in text.split(",")):
            if match := re.fullmatch(r"(cpu|mem):(\d+(?:\.\d+)?)", word):
                key, value = match[1], float(match[2])
                if key in found or not value or (key == "cpu" and value != int(value)):
                    raise LocalError(f"hardware {text!r}: {word}: expected each once, and whole CPUs")
                found[key] = value
                continue
            match = re.fullmatch(r"(?:gpu:)?([A-Za-z][A-Za-z0-9]*)(?::(\d+))?", word)
            model = next((known for known in GPUS if match and known.lower() == match[1].lower()), "")
            if not match or not model or gpu or match[2] == "0":
                raise LocalError(f"hardware {text!r}: {word or 'nothing'}: expected {_FORM}; GPUs: {', '.join(GPUS)}")
            gpu, found["gpus"] = model, float(match[2] or 1)
        return cls(int(found.get("cpu", 0)), found.get("mem", 0.0), gpu, int(found.get("gpus", 0)))

    def to_text(self) -> str:
        """Return the form that ``from_text`` reads; ``cpu:1`` without any requirement."""
        words = [f"cpu:{self.cpus}"] if self.cpus else []
        words += [f"mem:{self.memory_gib:g}"] if self.memory_gib else []
        words += [f"gpu:{self.gpu}:{self.gpus}"] if self.gpu else []
        return ",".join(words) or "cpu:1"

    def fits(self, other: Hardware) -> bool:
        """Return whether ``other`` has enough hardware."""
        return (
            other.cpus >= self.cpus
            and other.memory_gib >= self.memory_gib
            and (not self.gpu or (other.gpu == self.gpu and other.gpus >= self.gpus))
        )


@dataclass(frozen=True, slots=True)
class Offer:
    """One line of a provider's price list: a machine type in a region."""

    provider: str
    region: str
    type_name: str
    hardware: Hardware
    _: KW_ONLY
    is_spot: bool
    usd_per_hour: float
