"""Module entry ``python -m ring``.

I/O. Importing takes half a second, in which nothing is created yet: Ctrl-C then simply ends the process.
"""

import os
import signal

from lab import zygote

if __name__ == "__main__":
    signal.signal(signal.SIGINT, lambda number, _: os._exit(128 + number))
    zygote.install()
    from ring.cli import main

    main()
