"""Relay with a delay in both directions: ``relay.py DEVICE DEVICE MILLISECONDS``.

Process of its own, in the namespace between two machines. The relay is the one of the provider ``local``. It waits on
its standard input for permission to begin; here it has that from the start.
"""

from __future__ import annotations

import io
import sys

from fog.providers.local.delay import main

if __name__ == "__main__":
    sys.stdin = io.StringIO("\n")
    main()
