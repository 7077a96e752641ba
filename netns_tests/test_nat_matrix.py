"""Switches behind NATs: each pair reaches each other through one border, and directly where a direct path exists.

All 49 pairs: ``scripts/bench/nat_matrix.py``.
"""

from __future__ import annotations

import os
import shutil

import pytest

from lab.internet.access import Access
from lab.internet.laboratory import Laboratory
from lab.internet.matrix import measure

pytestmark = pytest.mark.netns

KINDS = (Access.PORT_RESTRICTED, Access.SYMMETRIC, Access.UDP_BLOCKED)


@pytest.mark.nightly
def test_switches_behind_nats_reach_each_other_and_directly_where_that_is_possible(laboratory: Laboratory) -> None:
    if shutil.which("wireguard-go") is None or not os.access("/dev/net/tun", os.R_OK | os.W_OK):
        pytest.skip("needs wireguard-go and /dev/net/tun")
    found = measure(laboratory, KINDS, timeout_s=180.0)
    assert {pair: outcome for pair, outcome in found.items() if not outcome.is_as_expected(pair)} == {}
