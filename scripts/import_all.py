#!/usr/bin/env python3
"""Import test of every module of the named packages.

    scripts/import_all.py gdp                 base installation; skips modules that need an extra
    scripts/import_all.py gdp proxy fog       with the extras proxy and fog; skips modules that need ROS, DDS or a cloud

Exit status: 0 all imported or skipped, 1 an import failed.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
EXTRAS = frozenset(
    {"boto3", "botocore", "cyclonedds", "genmsg", "genpy", "launch", "launch_ros", "PIL", "pkcs11", "rclpy", "redis"}
    | {"ros2cli", "ros2launch", "rosidl_parser", "roslib", "rospy", "rpyutils", "scapy", "sky"}
)  # packages that an installation may lack


def module_names(package: str) -> Iterator[str]:
    """Yield the package and its modules; those named ``__main__`` run something and are left out."""
    yield package
    folder = ROOT / package.replace(".", "/")
    for info in pkgutil.iter_modules([str(folder)], f"{package}."):
        if info.name.endswith(".__main__"):
            continue
        if info.ispkg:
            yield from module_names(info.name)
        else:
            yield info.name


def missing_extra(error: BaseException | None) -> str:
    """Return the extra package whose absence caused an import error; empty: another cause."""
    while error is not None:
        package = (getattr(error, "name", None) or "").partition(".")[0]
        if isinstance(error, ImportError) and package in EXTRAS:
            return package
        error = error.__cause__
    return ""


def main(packages: Sequence[str]) -> int:
    """Import the packages; return the exit status."""
    if not packages or packages[0].startswith("-"):
        print(__doc__)
        return 0 if packages else 2
    sys.path.insert(0, str(ROOT))
    imported, skipped, failed = 0, 0, 0
    for package in packages:
        for name in module_names(package):
            try:
                importlib.import_module(name)
                imported += 1
            except Exception as error:  # a package may translate the import error
                if extra := missing_extra(error):
                    skipped += 1
                    print(f"{name}: skipped, needs {extra}")
                else:
                    failed += 1
                    print(f"{name}: {type(error).__name__}: {error}", file=sys.stderr)
    print(f"Python {sys.version.split()[0]}: {imported} modules imported, {skipped} skipped, {failed} failed")
    return 1 if failed or not imported else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
