"""Exchange between holders, without a network: drawn histories, gaps, damages and forks."""

from __future__ import annotations

import os
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.capsule.holder import Ask
from gdp.errors import StoreError
from gdp.stores import capsule_store
from tests.draws import draws
from tests.gdp.capsule.log import Log
from tests.gdp.capsule.owned import descriptor, writer
from tests.gdp.stores.holder_sites import ABOUT, CHECKPOINTS, DATA, FILE_BYTES, LIMITS, STARTS, WIRES, Site, forked


@given(st.integers(1, len(DATA)), st.integers(1, len(DATA)), st.booleans())
@draws(25, long=300)
def test_each_ends_with_what_any_of_them_has(
    tmp_path_factory: pytest.TempPathFactory, first: int, second: int, restarts: bool
) -> None:
    folder = tmp_path_factory.mktemp("holders")
    with mock.patch.object(capsule_store, "SEGMENT_BYTES", FILE_BYTES):
        one, two = Site(folder, "one"), Site(folder, "two")
        one.append(DATA[:first], 0)
        two.append(DATA[:second], 0)
        if restarts:
            two.store.close()
            two.open()
        for _ in range(2):
            one.fetch(two)
            two.fetch(one)
    ends = [STARTS[at] + len(WIRES[at]) for at in CHECKPOINTS]
    proven = max([end for end in ends if end <= max(first, second)], default=0)
    for site, held in ((one, first), (two, second)):
        assert len(site.data) >= max(proven, *[at for at in STARTS if at <= held])
        assert site.data == DATA[: len(site.data)]
        assert site.faults == []


@given(st.sampled_from(range(1, len(WIRES))), st.integers(0, 60), st.integers(0, 60))
@draws(40, long=400)
def test_a_fork_is_named_by_its_first_record(
    tmp_path_factory: pytest.TempPathFactory, at: int, more: int, other: int
) -> None:
    """Two holders have each a history that the writer signed; they are the same up to a drawn record."""
    folder = tmp_path_factory.mktemp("holders")
    forks = [
        forked(at, [b"this"] * (1 + more % 7)),
        forked(at, [b"that, longer"] * (1 + other % 5)),
    ]
    one, two = Site(folder, "one"), Site(folder, "two")
    for site, fork in zip((one, two), forks, strict=True):
        site.append(b"".join([*WIRES[:at], *fork]), 0)
    for _ in range(2):
        one.fetch(two)
        two.fetch(one)
    words = one.faults + two.faults
    assert words
    assert all(f"record {at} forked: its writer {writer().name.to_text()} gave" in each for each in words), (at, words)


@given(st.data())
@draws(25, long=300)
def test_a_damaged_or_missing_segment_is_repaired_from_another_holder(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("holders")
    with mock.patch.object(capsule_store, "SEGMENT_BYTES", FILE_BYTES):
        one, two = Site(folder, "one"), Site(folder, "two")
        one.append(DATA, 0)
        two.append(DATA, 0)
        files = sorted((one.folder / ABOUT.name.to_text()).glob("*.records"))
        file = data.draw(st.sampled_from(files))
        how = data.draw(st.sampled_from(["flipped", "cut", "gone"]))
        wire, at = bytearray(file.read_bytes()), data.draw(st.integers(0, file.stat().st_size - 1))
        wire[at] ^= 1
        if how == "gone" and file not in (files[0], files[-1]):
            file.unlink()
        else:
            file.write_bytes(wire if how == "flipped" else wire[:at])
        if data.draw(st.booleans()):
            one.store.close()
            one.open()
        one.upkeep(two)
        assert one.data == two.data == DATA
        assert file == files[-1] or any("repaired from two" in each for each in one.faults)
        one.append(DATA[-10:], len(DATA) - 10)  # it takes records again
        (capsule,) = one.store.capsules
        assert capsule.audit(is_deep=True).findings == []
        assert capsule.damage == ""


def test_a_file_that_vanishes_under_a_running_holder_is_fetched_again(tmp_path: Path) -> None:
    with mock.patch.object(capsule_store, "SEGMENT_BYTES", FILE_BYTES):
        one, two = Site(tmp_path, "one"), Site(tmp_path, "two")
        one.append(DATA, 0)
        two.append(DATA, 0)
        sorted((one.folder / ABOUT.name.to_text()).glob("*.records"))[1].unlink()
        one.upkeep(two)
        assert one.data == DATA


def test_what_a_quota_refuses_is_not_read_and_hides_no_other_capsule(tmp_path: Path) -> None:
    abouts = [descriptor(f"/of-one/{number}") for number in range(5)]
    other = descriptor("/of-another", which=1)
    full, rich = Site(tmp_path, "full", replace(LIMITS, owner_bytes=4 << 20)), Site(tmp_path, "rich")
    for about in (*abouts, other):
        rich.append(b"".join(Log(writer().key, about.name).add(20).closed().wires), 0, about)
    with mock.patch.object(capsule_store, "SYNCED_MAX", 2):
        for _ in range(60):
            full.fetch(rich)
    held = {capsule.name for capsule in full.store.capsules}
    assert len(held) == 4
    read = {each.capsule for each in rich.answered if each.ask is Ask.READ}
    assert read == held
    assert any("quota" in each for each in full.faults)


def test_a_full_disk_ends_an_exchange(tmp_path: Path) -> None:
    one, two = Site(tmp_path, "one"), Site(tmp_path, "two")
    one.append(DATA, 0)
    Free = namedtuple("Free", "f_bavail f_frsize")
    with mock.patch.object(os, "statvfs", return_value=Free(1, 512)), pytest.raises(StoreError, match="No space left"):
        two.fetch(one)
    two.fetch(one)
    assert two.data == DATA
