"""Extras of the distribution: the error for a package that only some installations have.

I/O: it searches the installed packages.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec

from gdp.errors import LocalError

__all__ = ["MissingExtraError", "require_extra"]


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
        raise MissingExtraError(f"{user} needs {', '.join(missing)} (run: pip install 'gdp-ros[{extra}]')")
