"""Entry point of ``python -m memory_demo``."""

from memory_demo.cli import app

if __name__ == "__main__":
    app()
