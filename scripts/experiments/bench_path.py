"""Import path of the benches: importing this module lets the experiments import what they share with them.

I/O.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

__all__ = ["BENCHES", "ROOT"]

ROOT: Final = Path(__file__).resolve().parents[2]
BENCHES: Final = ROOT / "scripts" / "bench"

if str(BENCHES) not in sys.path:
    sys.path.append(str(BENCHES))
