"""Packages that only some installations have, and seams: where the core finds extensions through entry points.

I/O: it searches the installed packages. An error names the extra that is not installed.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final, Generic, TypeVar, cast

from gdp.errors import LocalError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")

_ROOT: Final = Path(__file__).resolve().parents[1]


class MissingExtraError(LocalError, ImportError):
    """A package of an extra is not installed; the text names the extra."""


def require_extra(extra: str, modules: Iterable[str], user: str) -> None:
    """Check that the modules of an extra are installed, without importing them.

    Args:
        user: what needs them, for the error.

    Raises:
        MissingExtraError: at least one is not installed.
    """
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise MissingExtraError(f"{user} needs {', '.join(missing)} (run: {install_command(extra)})")


def install_command(extras: str) -> str:
    """Return the command that installs extras: from the package index, or into a clone, by its own Python."""
    if (_ROOT / "pyproject.toml").is_file():
        return f"{sys.executable} -m pip install -e '{_ROOT}[{extras}]'"
    return f"pip install 'gdp-ros[{extras}]'"


@cache
def find_entry_point(group: str, name: str) -> EntryPoint | None:
    """Return an entry point whose package is there; None: none is. The answer stays the same in this process."""
    from importlib.metadata import PackageNotFoundError, distribution, entry_points  # slow; most commands need none

    with suppress(PackageNotFoundError):  # our own: without a search through all packages
        for each in distribution("gdp-ros").entry_points.select(group=group, name=name):
            if find_spec(each.module.partition(".")[0]) is not None:
                return each
    found = entry_points(group=group, name=name)
    return next((each for each in found if find_spec(each.module.partition(".")[0]) is not None), None)


@dataclass(frozen=True, slots=True)
class Seam(Generic[T]):
    """Place where the core calls an extension, which has a name and fulfils the protocol ``T``.

    Args:
        group: of entry points.
        extras: of this distribution, by name; without one the extra is called like the extension.
    """

    group: str
    extras: Mapping[str, str] = field(default_factory=dict)

    def get(self, name: str, user: str) -> T:
        """Return an extension; the first call imports it.

        Args:
            user: what needs it, for the error.

        Raises:
            MissingExtraError: the extension, or a package that it imports, is not installed.
        """
        command = install_command(self.extras.get(name, name))
        point = find_entry_point(self.group, name)
        if point is None:
            raise MissingExtraError(f"{user} needs the extension {name} (run: {command})")
        try:
            return cast("T", point.load())
        except ModuleNotFoundError as error:
            package = str(error.name).partition(".")[0]
            raise MissingExtraError(f"{user} needs {package} (run: {command})") from error
