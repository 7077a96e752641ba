"""Program that says what it has inherited, as JSON."""

import atexit
import json
import os
import signal
import sys
import threading
import time
from pathlib import Path


def main() -> None:
    """Print the surroundings; or wait for a signal; or fail; or end while a thread goes on."""
    if "--wait" in sys.argv:
        print("waiting", flush=True)
        while True:
            signal.pause()
    if "--fail" in sys.argv:
        raise ValueError("as asked")
    if "--end" in sys.argv:
        atexit.register(print, "at its end")
        threading.Thread(target=lambda: time.sleep(0.1) or print("in a thread")).start()  # type: ignore[func-returns-value]
        sys.exit(7)
    descriptors = [int(each) for each in os.listdir("/proc/self/fd")]
    umask = os.umask(0)
    command = Path("/proc/self/cmdline").read_bytes().rstrip(b"\0").split(b"\0")
    seen = {
        "argv": sys.argv,
        "cwd": os.getcwd(),
        "seen": os.environ.get("SEEN"),
        "path": sys.path,
        "descriptors": sorted(each for each in descriptors if Path(f"/proc/self/fd/{each}").exists()),
        "umask": umask,
        "pid": os.getpid(),
        "parent": os.getppid(),
        "session": os.getsid(0),
        "group": os.getpgid(0),
        "net": os.readlink("/proc/self/ns/net"),
        "command": [each.decode() for each in command],
    }
    print(json.dumps(seen))


if __name__ == "__main__":
    main()
