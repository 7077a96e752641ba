"""Bucket of a holder: what is confirmed is there, the disk is a cache, and each damage and refusal is named."""

from __future__ import annotations

import random
import shutil
import socket
import subprocess
import sys
import threading
import uuid
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path

import pytest

from gdp.capsule.holder import Ask
from gdp.errors import GdpError, LocalError, StoreError
from gdp.intervals import HOUR_S
from gdp.names import Name
from gdp.stores import bucket as bucket_module
from gdp.stores import bucket_upkeep
from gdp.stores.bucket import Bucket, StoredObject
from gdp.stores.bucket_folder import note_place, object_key, refuse_other_place, remove_with_bucket, stored_with_bucket
from gdp.stores.capsule_store import object_of
from gdp.stores.holder_exchange import run
from gdp.stores.holder_upkeep import HolderUpkeep
from gdp.stores.transactions import TransactionFile
from tests.draws import TIMES
from tests.gdp.capsule.log import SECOND_NS
from tests.gdp.capsule.owned import NOW_S
from tests.gdp.stores.bucket_sites import LIMITS, OTHER, BackedSite, environment, s3_server, short_segments
from tests.gdp.stores.holder_sites import ABOUT, DATA, WIRES, Site
from tests.pages import ROOT

KILLS = 8 * TIMES


@pytest.fixture(scope="module", autouse=True)
def s3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with s3_server(tmp_path_factory.mktemp("aws")) as url:
        yield url


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    short_segments(monkeypatch)


@pytest.fixture
def site(tmp_path: Path) -> Iterator[BackedSite]:
    made = BackedSite(tmp_path / "store", uuid.uuid4().hex)
    yield made
    made.close()
    made.bucket.close()


def emptied(site: BackedSite) -> None:
    """Give a holder an empty disk."""
    site.close()
    shutil.rmtree(site.folder)
    site.open()


def test_a_record_is_confirmed_when_the_bucket_has_it(site: BackedSite) -> None:
    answer = site.append(DATA, 0)
    assert (answer.head, answer.offset) == (0, len(DATA))
    site.upkeep.run_round(0.0)
    closed = site.ask(Ask.HEAD).head
    assert closed == site.capsule.segments.last == sum(site.objects.values())
    assert len(site.objects) > 2, "closed segments are uploaded at once"
    site.upkeep.run_round(59.0)
    assert site.ask(Ask.HEAD).head == closed, "an open one waits"
    site.upkeep.run_round(60.0)
    assert site.ask(Ask.HEAD).head == len(DATA) == sum(site.objects.values())


def test_an_open_segment_is_uploaded_again_as_it_grows(site: BackedSite) -> None:
    at = 0
    for size in (700, 900, 300, 5_000):
        at = site.append(DATA[at : at + size], at).offset
        assert site.round() == site.capsule.segments.end
        assert site.objects == site.files
    assert site.data == DATA[: site.capsule.segments.end]


def test_a_round_looks_only_at_segments_that_changed(site: BackedSite, monkeypatch: pytest.MonkeyPatch) -> None:
    looked = list[int]()

    def look(index: TransactionFile, name: Name, offset: int) -> StoredObject | None:
        looked.append(offset)
        return object_of(index, name, offset)

    at = site.append(DATA[:9_000], 0).offset
    site.round()
    site.upkeep.run_round(site.now_s)  # sees that all is there
    monkeypatch.setattr(bucket_upkeep, "object_of", look)
    site.upkeep.run_round(site.now_s)
    assert (looked, len(site.objects) > 1) == ([], True)
    open_one = site.capsule.segments.last
    site.append(DATA[at : at + 300], at)
    site.upkeep.run_round(site.now_s)
    assert set(looked) == {open_one}
    site.round()
    assert site.objects == site.files
    key = object_key(ABOUT.name, 0)
    site.bucket.delete(key)
    site.upkeep.run_round(site.now_s + HOUR_S)  # the comparison finds that it is gone
    site.upkeep.run_round(site.now_s + HOUR_S)
    assert site.objects == site.files


def test_counted_bytes_are_those_of_the_files(tmp_path: Path) -> None:
    site = BackedSite(tmp_path, uuid.uuid4().hex, replace(LIMITS, capsule_bytes=12_000, cache_bytes=9_000))
    at = 0
    while at < len(DATA):
        at = site.append(DATA[at : at + 1_500], at).offset
        site.round()
        segments = site.capsule.segments
        assert segments.here_bytes == sum(site.files.values())
        assert segments.held_bytes == sum(map(segments.size_of, segments.offsets))
    assert 0 < segments.here_bytes < segments.held_bytes
    assert segments.begin > 0
    assert site.data == DATA[segments.begin :]
    assert segments.here_bytes == sum(site.files.values())
    site.close()


def test_a_slow_topic_ends_its_segment_after_ten_minutes(site: BackedSite, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gdp.stores.capsule_store._BACKED_NS", 4 * SECOND_NS)
    monkeypatch.setattr("gdp.stores.capsule_store.SEGMENT_BYTES", 1 << 30)
    site.append(DATA, 0)
    times = [site.capsule.segments.read(each, 100)[1][13:21] for each in site.capsule.segments.offsets]
    seconds = [int.from_bytes(each, "big") / SECOND_NS for each in times]
    assert len(seconds) == 3
    assert all(4 <= later - earlier < 6 for earlier, later in pairwise(seconds))


def test_an_empty_disk_serves_all_that_was_confirmed_and_the_writer_continues(site: BackedSite) -> None:
    at = site.append(DATA[:9_000], 0).offset
    confirmed = site.round()
    site.append(DATA[at : at + 2_000], at)
    emptied(site)
    answer = site.ask(Ask.HEAD)
    assert (answer.head, answer.offset) == (confirmed, confirmed)
    assert site.data == DATA[:confirmed]
    with pytest.raises(StoreError, match="bytes before"):  # the writer has them, and asks for the head
        site.append(DATA[at:], at)
    assert site.append(DATA[confirmed:], confirmed).offset == len(DATA)
    assert site.round() == len(DATA)
    emptied(site)
    assert site.data == DATA
    found = site.ask(Ask.READ, time_ns=4 * SECOND_NS)
    assert 2 * SECOND_NS < int.from_bytes(found.data[13:21], "big") <= 4 * SECOND_NS
    audit = site.capsule.audit(is_deep=True)
    assert (audit.findings, audit.records) == ([], len(WIRES))
    assert site.faults == []


def test_the_disk_is_a_cache_and_what_it_lacks_is_fetched(tmp_path: Path) -> None:
    site = BackedSite(tmp_path / "store", uuid.uuid4().hex, replace(LIMITS, cache_bytes=3 * 4_000))
    at = 0
    while at < len(DATA):
        at = site.append(DATA[at : at + 1_000], at).offset
        site.round()
        assert sum(site.files.values()) <= 3 * 4_000
    assert site.objects.keys() > site.files.keys()
    for _ in range(2):
        assert site.data == DATA
        site.upkeep.run_round(site.now_s)
        assert sum(site.files.values()) <= 3 * 4_000
        site.restart()
    site.close()
    note_place(site.folder, site.url)
    (found,) = stored_with_bucket(site.folder)
    assert found.audit().findings == []
    assert found.segments.held_bytes == len(DATA)
    assert sum(site.files.values()) <= 3 * 4_000
    with pytest.raises(LocalError, match=site.url):
        refuse_other_place(site.folder, None)


def test_a_bucket_that_is_gone_loses_nothing_and_a_full_disk_refuses(
    tmp_path: Path, s3: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = BackedSite(tmp_path / "store", uuid.uuid4().hex, replace(LIMITS, cache_bytes=8_000))
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
    site.upkeep._bucket = Bucket(site.url)
    at = 0
    for _ in range(8):
        at = site.append(DATA[at : at + 1_000], at).offset
        with pytest.raises(StoreError, match=f"{site.url}: .*cannot be reached"):
            site.round()
    with pytest.raises(StoreError, match="disk here has 8000 bytes for what the bucket lacks"):
        site.append(DATA[at : at + 1_000], at)
    assert site.ask(Ask.HEAD).head == 0
    assert site.data == DATA[: site.capsule.segments.end]
    site.upkeep._bucket = site.bucket
    assert site.round() == site.capsule.segments.end
    while at < len(DATA):
        at = site.append(DATA[at : at + 1_000], at).offset
        site.round()
    assert site.data == DATA
    site.close()


def test_a_bucket_that_does_not_answer_delays_no_append(site: BackedSite, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bucket_module, "SERVER_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{silent.getsockname()[1]}")
        site.upkeep._bucket = Bucket(site.url)
        site.append(DATA[:9_000], 0)
        failed = list[str]()

        def upload() -> None:
            try:
                site.round()
            except StoreError as error:
                failed.append(str(error))

        thread = threading.Thread(target=upload)
        thread.start()
        asking, _ = silent.accept()  # the request is under way
        assert site.append(DATA[9_000:], 9_000).offset == len(DATA)
        assert thread.is_alive()
        thread.join()
        asking.close()
    assert "cannot be reached" in failed[0]
    assert "timeout" in failed[0].lower()


@pytest.mark.parametrize(
    ("status", "code", "words"),
    [
        (403, "AccessDenied", "need to list, get, put and delete"),
        (403, "InvalidAccessKeyId", "credentials are not valid"),
        (404, "NoSuchBucket", "make it first"),
        (507, "XMinioStorageFull", "it is full"),
        (403, "QuotaExceeded", "it is full"),
    ],
)
def test_a_refusal_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int, code: str, words: str
) -> None:
    class Refuser(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = f"<Error><Code>{code}</Code><Message>no</Message></Error>".encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
            del code, size

    with ThreadingHTTPServer(("127.0.0.1", 0), Refuser) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        for key, value in environment(f"http://127.0.0.1:{server.server_port}", tmp_path).items():
            monkeypatch.setenv(key, value)
        with pytest.raises(GdpError, match=words) as refused:
            BackedSite(tmp_path / "store", "any")
        server.shutdown()
        thread.join()
    assert isinstance(refused.value, StoreError) == (words == "it is full")


@pytest.mark.parametrize("url", ["", "capsules", "s3://", "s3:///p", "http://capsules/p", "s3://not a name"])
def test_a_url_that_names_no_bucket_is_refused(url: str) -> None:
    with pytest.raises(LocalError, match=r"s3://NAME/PREFIX|[Bb]ucket"), Bucket(url) as bucket:
        bucket.get("holder")


def test_what_is_dropped_leaves_the_bucket_too(tmp_path: Path) -> None:
    site = BackedSite(tmp_path / "bytes", uuid.uuid4().hex, replace(LIMITS, capsule_bytes=10_000))
    site.append(DATA[:9_000], 0)
    site.round()
    site.append(DATA[9_000:], 9_000)
    site.round()
    assert site.objects == site.files
    assert 0 < site.begin == min(site.objects)
    assert site.data == DATA[site.begin :]
    site.close()
    note_place(site.folder, site.url)
    remove_with_bucket(site.folder, ABOUT.name)
    assert list(stored_with_bucket(site.folder)) == []
    site.open()
    assert site.store.capsules == []
    assert [key for key, _ in site.bucket.list()] == ["holder"]
    site.close()
    aged = BackedSite(tmp_path / "age", uuid.uuid4().hex, replace(LIMITS, age_s=NOW_S))
    aged.append(DATA, 0)
    aged.round()
    aged.unix_s = NOW_S + 8.0  # the records say that they are of the first twelve seconds
    aged.store.retire(aged.capsule)
    aged.round()
    assert 0 < aged.begin == min(aged.objects)
    aged.close()


def test_two_holders_share_no_prefix_and_the_one_that_lost_it_takes_no_more(tmp_path: Path, site: BackedSite) -> None:
    site.append(DATA[:9_000], 0)
    confirmed = site.round()
    second = BackedSite.__new__(BackedSite)
    second.__dict__.update({**site.__dict__, "folder": tmp_path / "second", "holder": OTHER})
    with pytest.raises(LocalError, match=f"holder {site.holder.to_text()} uses it; give each holder a prefix"):
        second.open()
    second.open(takes=True)
    assert second.data == DATA[:confirmed]
    site.append(DATA[9_000:12_000], 9_000)
    with pytest.raises(StoreError, match=f"holder {OTHER.to_text()} uses it now"):
        site.round()
    with pytest.raises(StoreError, match="takes no records any more"):
        site.append(DATA[12_000:], 12_000)
    assert site.ask(Ask.HEAD).head == confirmed
    assert second.append(DATA[confirmed:], confirmed).offset == len(DATA)
    assert second.round() == len(DATA)
    emptied(second)
    assert second.data == DATA
    second.close()


@pytest.mark.parametrize(
    ("disk", "how", "where"),
    [
        ("kept", "truncated", "last"),
        ("kept", "older", "middle"),
        ("kept", "gone", "last"),
        ("empty", "truncated", "middle"),
        ("empty", "older", "last"),
        ("empty", "gone", "middle"),
        ("empty", "altered", "middle"),
        ("running", "altered", "middle"),
        ("running", "older", "last"),
    ],
)
def test_an_object_that_is_not_what_was_uploaded_is_named_and_replaced(
    tmp_path: Path, disk: str, how: str, where: str
) -> None:
    """The disk has it, or another holder; what an empty disk cannot know is named by the writer."""
    site, peer = BackedSite(tmp_path / "store", uuid.uuid4().hex), Site(tmp_path, "peer")
    site.append(DATA, 0)
    peer.append(DATA, 0)
    site.round()
    offset = site.capsule.segments.offsets[-1 if where == "last" else 2]
    found = site.bucket.get(site.key(offset))
    assert found is not None
    data, records = found[0], [each for each in WIRES if DATA.index(each) >= offset]
    older = b"".join(records[:4])
    assert len(older) < len(data)
    if how == "gone":
        site.bucket.delete(site.key(offset))
    else:
        wrong = {"truncated": data[:-30], "older": older, "altered": data[:-9] + bytes([data[-9] ^ 1]) + data[-8:]}[how]
        site.overwrite(offset, wrong)
    if disk == "kept":
        site.restart()
    elif disk == "empty":
        emptied(site)
    else:
        site.now_s += HOUR_S
    if disk != "empty":
        site.round()
        assert any(f"bucket's segment at {offset} is " in each for each in site.faults)
    else:
        named = [each for each in site.faults if f"bucket's segment at {offset} is damaged behind" in each]
        assert bool(named) == (how in ("truncated", "altered"))
        assert site.ask(Ask.HEAD).head == len(DATA) or where == "last"
        keep = HolderUpkeep(site.store, ["peer"], 0.0)
        for second in range(3):
            for holder, steps in keep.handle_timer(float(second)):
                run(steps, peer.answer)
                keep.ended(holder, float(second))
    site.round()
    assert site.data == DATA
    emptied(site)
    assert site.data == DATA, "the bucket has it again"
    site.close()


def test_an_object_that_was_exchanged_is_named_when_it_is_read(site: BackedSite) -> None:
    site.append(DATA, 0)
    site.round()
    offset = site.capsule.segments.offsets[2]
    found = site.bucket.get(site.key(offset))
    assert found is not None
    site.capsule.segments.evict(offset)
    site.overwrite(offset, found[0][:-20])
    given = site.ask(Ask.READ, offset).data
    assert found[0].startswith(given)
    assert 0 < len(given) < len(found[0]) - 20, "whole records that the writer signed"
    assert [each for each in site.faults if f"segment at {offset} is exchanged" in each]


def test_a_damaged_segment_is_repaired_from_the_bucket(site: BackedSite) -> None:
    site.append(DATA, 0)
    site.round()
    for offset in (site.capsule.segments.offsets[1], site.capsule.segments.last):
        path = site.folder / ABOUT.name.to_text() / f"{offset:016x}.records"
        good = path.read_bytes()
        path.write_bytes(good[:90] + bytes([good[90] ^ 1]) + good[91:])
    site.restart()
    keep = HolderUpkeep(site.store, [], 0.0)
    for second in range(40):
        keep.handle_timer(float(second))
    assert (
        len([each for each in site.faults if "repaired from the bucket" in each]) == 1
    )  # the last one of each capsule
    assert site.data == DATA
    assert site.capsule.audit(is_deep=True).findings == []
    assert site.append(DATA[-10:], len(DATA) - 10).head == len(DATA), "it takes records again"


def test_a_bucket_of_a_capsule_that_another_owner_signed_restores_nothing(site: BackedSite) -> None:
    site.append(DATA, 0)
    site.round()
    key = f"{ABOUT.name.to_text()}/descriptor.cbor"
    found = site.bucket.get(key)
    assert found is not None
    site.bucket.put(key, found[0][:-1], found[1])
    emptied(site)
    assert site.store.capsules == []
    assert any("not restored from the bucket" in each for each in site.faults)


@pytest.mark.parametrize("seed", range(KILLS))
def test_nothing_confirmed_is_lost_when_the_holder_is_killed(tmp_path: Path, seed: int) -> None:
    """It dies at a drawn point: before or after an upload, the note of it, a removal here or a deletion there."""
    rng, prefix = random.Random(seed), uuid.uuid4().hex
    limits = replace(LIMITS, cache_bytes=12_000, capsule_bytes=rng.choice([None, 12_000]))
    confirmed = 0
    (tmp_path / "descriptor").write_bytes(ABOUT.to_cbor())
    (tmp_path / "records").write_bytes(DATA)
    for _ in range(2):
        words = [str(tmp_path), prefix, str(rng.randrange(1, 90)), str(limits.capsule_bytes or 0)]
        done = subprocess.run(
            [sys.executable, "-m", "tests.gdp.stores.killed_holder", *words],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode in (0, -9), done.stderr
        confirmed = max([confirmed, *map(int, done.stdout.split())])
    if rng.random() < 0.5:
        shutil.rmtree(tmp_path / "store")
    site = BackedSite(tmp_path / "store", prefix, limits)
    found = site.ask(Ask.HEAD) if site.store.capsules else None
    head = 0 if found is None else found.head
    assert head >= confirmed
    if found is not None:
        assert site.data == DATA[site.begin : found.offset]
        assert site.begin == 0 or limits.capsule_bytes
    at = 0 if found is None else found.offset
    while at < len(DATA):
        at = site.append(DATA[at : at + 1_500], at).offset
        site.round()
    assert site.ask(Ask.HEAD).head == len(DATA)
    site.round()
    assert site.data == DATA[site.begin :]
    assert [each for each in site.objects if each < site.begin] == [], "what was dropped is not in the bucket"
    assert site.faults == []
    site.close()
