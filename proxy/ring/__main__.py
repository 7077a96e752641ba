"""``python -m proxy.ring``.

Place: shell.
"""

from proxy.ring.cli import main

if __name__ == "__main__":
    main()
