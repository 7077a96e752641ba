"""Lets tests import what lies under ``scripts/experiments`` by its bare name, as those scripts do among themselves."""

from __future__ import annotations

import sys

from tests.pages import ROOT

sys.path.append(str(ROOT / "scripts" / "experiments"))
