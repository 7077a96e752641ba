"""Program that calls one function, given as ``MODULE:FUNCTION``, with further words as texts.

    python -m lab.call netns_tests.test_accounting:read_frames q1 4096

``process.calling`` makes this command line. So a function that a test needs in a process of its own is in the test.
"""

from __future__ import annotations

import importlib
import sys

if __name__ == "__main__":
    module, _, function = sys.argv[1].partition(":")
    getattr(importlib.import_module(module), function)(*sys.argv[2:])
