"""Entry point of ``python -m fog_demo``."""

from lab import zygote

if __name__ == "__main__":
    zygote.run_command("fog_demo.cli")
