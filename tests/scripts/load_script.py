"""Loader of a script as a module, for tests of scripts that no package holds."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

from tests.pages import ROOT


def load_script(name: str) -> ModuleType:
    """Return ``scripts/NAME`` as a module of its bare name."""
    spec = importlib.util.spec_from_file_location(name.removesuffix(".py"), ROOT / "scripts" / name)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
