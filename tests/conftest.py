"""Fixtures of every test."""

from __future__ import annotations

import os
import signal

import hypothesis

from gdp.control.boundary import ErrorBoundary
from lab.process import python_path


def pytest_configure() -> None:
    """Accept Ctrl-C again: a shell starts background processes with it ignored, and children inherit that.

    Errors that a node would contain fail the test that draws them. No generated example has a time limit: how long it
    takes depends on the machine's load.
    """
    hypothesis.settings.register_profile("unhurried", deadline=None)
    hypothesis.settings.load_profile("unhurried")
    ErrorBoundary.reraises = True
    os.environ["PYTHONPATH"] = python_path()  # of started processes
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
