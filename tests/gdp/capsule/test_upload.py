"""Upload to a holder that confirms later than it takes records."""

from __future__ import annotations

from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.upload import Span, Uploader
from gdp.capsule.windows import Windows
from gdp.intervals import POLL_S, RETRY_S
from tests.gdp.capsule.owned import descriptor

ABOUT = descriptor()
END = 900


def begun() -> Uploader:
    """Return an upload to a holder that has nothing."""
    uploader = Uploader(ABOUT.name, ABOUT)
    assert isinstance(uploader.next_step(0, END, 0.0), HolderRequest)
    uploader.handle_response(HolderAnswer().to_cbor(), END, 0.0)
    return uploader


def test_a_holder_that_took_all_is_asked_until_it_confirms() -> None:
    uploader = begun()
    assert uploader.next_step(0, END, 0.0) == Span(0, END)
    assert uploader.append(0, bytes(END)).gap == 0
    uploader.handle_response(HolderAnswer(head=300, offset=END).to_cbor(), END, 0.0)
    assert uploader.confirmed == 300
    assert uploader.next_step(0, END, 0.0) is None
    assert uploader.next_step(0, END, POLL_S - 0.1) is None
    asked = uploader.next_step(0, END, POLL_S)
    assert isinstance(asked, HolderRequest)
    assert asked.ask is Ask.HEAD
    uploader.handle_response(HolderAnswer(head=END, offset=END).to_cbor(), END, POLL_S)
    assert uploader.next_step(0, END, 60.0) is None
    assert uploader.poll_faults() == []


def test_records_that_a_holder_lost_with_its_disk_are_sent_again() -> None:
    uploader = begun()
    uploader.next_step(0, END, 0.0)
    uploader.handle_response(HolderAnswer(head=300, offset=END).to_cbor(), END, 0.0)
    uploader.next_step(0, END, 0.0)
    uploader.next_step(0, END, POLL_S)
    uploader.handle_response(HolderAnswer(head=300, offset=300).to_cbor(), END, POLL_S)
    assert uploader.next_step(0, END, POLL_S) == Span(300, END - 300)
    assert uploader.poll_faults() == []


def test_what_is_left_out_is_stated() -> None:
    windows = Windows(0, 0)
    windows.open(500, 1)
    uploader = begun()
    assert uploader.next_step(0, END, 0.0, windows) == Span(500, END - 500)
    assert uploader.append(500, b"").gap == 500
    assert uploader.append(600, b"").gap == 600, "the ring dropped more meanwhile"


def test_pauses_grow_with_refusals_and_not_with_silences() -> None:
    for is_silent in (True, False):
        uploader, now_s, pauses_s = begun(), 0.0, list[float]()
        for _ in range(4):
            failed_s = now_s
            uploader.handle_failure("no", now_s, is_silent=is_silent)
            while uploader.next_step(0, END, now_s) is None:
                now_s += 1.0
            pauses_s.append(now_s - failed_s)
        assert pauses_s == [RETRY_S] * 4 if is_silent else pauses_s == [RETRY_S * 2**n for n in range(4)]
