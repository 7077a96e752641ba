"""``python -m fog_demo``.

I/O. Importing takes a second, in which nothing has been made yet: Ctrl-C then simply ends the process.
"""

import os
import signal

if __name__ == "__main__":
    signal.signal(signal.SIGINT, lambda number, _: os._exit(128 + number))
    from fog_demo.cli import main

    main()
