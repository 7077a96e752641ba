"""Import path of the benches and of the package ``grasp``: importing this module lets the experiments import both.

I/O.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
BENCHES: Final = ROOT / "scripts" / "bench"

sys.path += [str(each) for each in (BENCHES, ROOT / "examples" / "grasp") if str(each) not in sys.path]
