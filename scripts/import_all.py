#!/usr/bin/env python3
"""Import test of every module of the named packages.

    scripts/import_all.py gdp                 base installation; skips modules that need an extra
    scripts/import_all.py gdp proxy fog       with all extras

Exit status: 0 all imported or skipped, 1 an import failed.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
EXTRAS = frozenset({"pkcs11", "redis", "scapy"})  # packages that modules of gdp import and a base installation lacks


def module_names(package: str) -> Iterator[str]:
    """Yield the package and its modules; those named ``__main__`` run something and are left out."""
    yield package
    imported = importlib.import_module(package)
    for info in pkgutil.iter_modules(imported.__path__, f"{package}."):
        if info.name.endswith(".__main__"):
            continue
        if info.ispkg:
            yield from module_names(info.name)
        else:
            yield info.name


def main(packages: Sequence[str]) -> int:
    """Import the packages; return the exit status."""
    if not packages or packages[0].startswith("-"):
        print(__doc__)
        return 0 if packages else 2
    sys.path.insert(0, str(ROOT))
    imported, failed = 0, 0
    for package in packages:
        for name in module_names(package):
            try:
                importlib.import_module(name)
                imported += 1
            except ImportError as error:
                if (error.name or "").partition(".")[0] in EXTRAS:
                    print(f"{name}: skipped, needs {error.name}")
                else:
                    failed += 1
                    print(f"{name}: {error}", file=sys.stderr)
    print(f"Python {sys.version.split()[0]}: {imported} modules imported, {failed} failed")
    return 1 if failed or not imported else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
