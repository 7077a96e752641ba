"""Folder of wheels for rented machines: this package, the user's nodes, and all that they need.

I/O; runs pip of this environment. Dependencies have the versions that are installed here, so machines run what was
tested; a package that is not installed here has the newest version. Wheels are those of the machine's platform, which
may be another one than this machine's.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from gdp.errors import LocalError

_PACKAGE: Final = "gdp-ros"
_PATIENCE_S: Final = 1_800.0


@dataclass(frozen=True, slots=True)
class Platform:
    """Platform of the machines.

    Args:
        python: version of their Python, such as ``3.11``.
        tags: platform tags of wheels, best first.
    """

    python: str
    tags: tuple[str, ...]


_MANYLINUX: Final = tuple(f"manylinux_2_{minor}_x86_64" for minor in range(36, 16, -1))
DEBIAN_12: Final = Platform("3.11", (*_MANYLINUX, "manylinux2014_x86_64", "linux_x86_64"))


def wheels(
    folder: Path, sources: Sequence[str] = (), platform: Platform = DEBIAN_12, build: Sequence[str] = ()
) -> list[Path]:
    """Fill a folder with the wheels of this package, of ``sources``, and of all dependencies; return all of them.

    Args:
        sources: folders of Python projects with nodes, or requirements of pip.
        build: packages of pure Python that have no wheel on the index, and are built here.

    Raises:
        LocalError: the source of this package is not here, or pip fails; the text has its last lines.
    """
    folder.mkdir(parents=True, exist_ok=True)
    built = [build_wheel(own_project(), folder)]
    others = []
    for source in sources:
        if Path(source).is_dir():
            built.append(build_wheel(Path(source), folder))
        else:
            others.append(source)
    if build:
        known = _installed()
        pinned = [f"{name}=={known[name]}" if name in known else name for name in build]
        _pip("wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), *pinned)
    own, *nodes = (str(each.resolve()) for each in built)
    dependency_wheels([f"{own}[proxy]", *nodes, *others], folder, platform)
    return sorted(folder.glob("*.whl"))


def own_project() -> Path:
    """Return the source folder of this package. Raises ``LocalError``: it was installed from a wheel."""
    text = metadata.distribution(_PACKAGE).read_text("direct_url.json")
    url = urlsplit(json.loads(text)["url"]) if text else None
    here = Path(__file__).resolve().parents[2]
    if (here / "pyproject.toml").is_file():
        return here
    if url is not None and url.scheme == "file" and Path(unquote(url.path)).is_dir():
        return Path(unquote(url.path))
    raise LocalError(
        f"the source of {_PACKAGE} is not here: run `fog wheels` from a clone of it, after scripts/setup.sh"
    )


def build_wheel(project: Path, folder: Path) -> Path:
    """Build a project's wheel with this environment's setuptools, without a network; return it.

    Raises:
        LocalError: the build fails.
    """
    with tempfile.TemporaryDirectory(prefix="gdp-wheel-") as scratch:
        # of a copy, because setuptools builds inside the project
        ignored = shutil.ignore_patterns(".git", ".venv", "build", "*.egg-info", "__pycache__", "site")
        copy = shutil.copytree(project, Path(scratch) / "project", ignore=ignored, symlinks=True)
        made = Path(scratch) / "wheel"
        _pip("wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(made), str(copy))
        (wheel,) = made.glob("*.whl")
        return Path(shutil.move(wheel, folder / wheel.name))


def dependency_wheels(requirements: Sequence[str], folder: Path, platform: Platform) -> None:
    """Download the wheels of all dependencies for a platform, in the versions that are installed here.

    Raises:
        LocalError: a dependency has no wheel for the platform, or the index cannot be reached.
    """
    with tempfile.NamedTemporaryFile("w", suffix=".txt", encoding="utf-8") as constraints:
        constraints.writelines(f"{name}=={version}\n" for name, version in sorted(_installed().items()))
        constraints.flush()
        tags = [word for tag in platform.tags for word in ("--platform", tag)]
        options = ["--quiet", "--only-binary=:all:", "--python-version", platform.python, *tags]
        _pip(
            "download",
            *options,
            "--constraint",
            constraints.name,
            "--find-links",
            str(folder),
            "--dest",
            str(folder),
            *requirements,
        )


def _installed() -> dict[str, str]:
    """Return name -> version of the packages here, but this one, which is built."""
    found = ((each.metadata["Name"], each.version) for each in metadata.distributions())
    return {name: version for name, version in found if name and name.lower().replace("_", "-") != _PACKAGE}


def _pip(*words: str) -> None:
    argv = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input", *words]
    try:
        done = subprocess.run(argv, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise LocalError(f"pip {words[0]}: not done within {_PATIENCE_S:.0f} s") from error
    if done.returncode:
        raise LocalError(f"pip {words[0]} failed: {' '.join(done.stderr.strip().splitlines()[-4:])}")
