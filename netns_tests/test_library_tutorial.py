"""Tutorial of the library, followed literally."""

from __future__ import annotations

import signal
import sys

import pytest

from netns_tests.session_lab import lines_of, session_lab
from tests.pages import ROOT, blocks

pytestmark = pytest.mark.netns

_PAGE = ROOT / "docs/tutorials/library.md"


def test_the_tutorial_of_the_library_does_what_it_says() -> None:
    shown = blocks(_PAGE)
    make, delegate, nodes = (block.text for block in shown if block.language == "bash")
    (rights,) = (block for block in shown if block.language == "yaml")
    subscribe, publish, serve, call, subscribe_async = (block.text for block in shown if block.language == "python")
    with session_lab({}) as lab:
        (lab.folder / rights.title).write_text(rights.text)
        for script in (make, delegate):
            lab.output("bash", "-e", "-c", script)
        for line in nodes.splitlines():
            node = lab.launch([*line.removesuffix(" &").split(), "--json"])
            assert '"ready"' in lines_of(node, 1)[0]
        for program in (subscribe, subscribe_async):
            reader = lab.python("-c", program)
            lab.output(sys.executable, "-c", publish)
            assert "b'hello'" in lines_of(reader, 1)[0]
            reader.finish(signal.SIGTERM)
        lab.python("-c", serve)
        lab.python("-c", serve.replace('"edge"', '"server"'))
        assert lab.output(sys.executable, "-c", call).startswith("b'tobor' from ")
