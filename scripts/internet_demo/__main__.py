"""Entry point of ``python -m internet_demo``."""

from lab import zygote

if __name__ == "__main__":
    zygote.run_command("internet_demo.cli")
