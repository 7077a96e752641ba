"""Closing in another thread: nothing waits for it but who opens the same device again."""

from __future__ import annotations

import errno
import threading

import pytest

from gdp.ports.raw import Closing


def test_who_opens_a_device_again_waits_for_its_end_and_for_no_other() -> None:
    closing, released, closed = Closing(), threading.Event(), list[str]()
    closing.close("a0", [released.wait, lambda: closed.append("a0")])
    closing.close("b0", [lambda: closed.append("b0"), lambda: closed.append("b0")])
    closing.wait("b0")
    closing.wait("c0")
    assert closed == ["b0", "b0"]
    released.set()
    closing.wait()
    assert closed == ["b0", "b0", "a0"]


def test_what_one_close_raises_keeps_no_other_open(monkeypatch: pytest.MonkeyPatch) -> None:
    closing, closed, raised = Closing(), list[str](), list[threading.ExceptHookArgs]()
    monkeypatch.setattr(threading, "excepthook", raised.append)

    def fail() -> None:
        raise OSError(errno.EIO, "gone")

    closing.close("a0", [lambda: closed.append("first"), fail, lambda: closed.append("last")])
    closing.wait()
    assert closed == ["first", "last"]
    assert [each.exc_type for each in raised] == [OSError]
