"""Import path for modules under ``scripts/experiments`` by bare name, as those scripts import each other."""

from __future__ import annotations

import sys

from tests.pages import ROOT

sys.path.append(str(ROOT / "scripts" / "experiments"))
