"""Entry point of ``python -m ring``."""

from lab import zygote

if __name__ == "__main__":
    zygote.run_command("ring.cli")
