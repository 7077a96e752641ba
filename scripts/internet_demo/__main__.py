"""Entry point of ``python -m internet_demo``.

I/O. Imports take one second, in which no resource exists yet, so Ctrl-C then ends the process directly.
"""

import os
import signal

from lab import zygote

if __name__ == "__main__":
    signal.signal(signal.SIGINT, lambda number, _: os._exit(128 + number))
    zygote.install()
    from internet_demo.cli import main

    main()
