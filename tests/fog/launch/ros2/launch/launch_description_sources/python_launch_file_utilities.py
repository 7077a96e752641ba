"""Loader of launch files."""

from __future__ import annotations

from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..launch_description import LaunchDescription


def load_python_launch_file_as_module(python_launch_file_path: str) -> ModuleType:
    loader = SourceFileLoader("python_launch_file", python_launch_file_path)
    spec = spec_from_loader(loader.name, loader)
    assert spec is not None
    made = module_from_spec(spec)
    loader.exec_module(made)
    return made


def get_launch_description_from_python_launch_file(python_launch_file_path: str) -> LaunchDescription:
    made = load_python_launch_file_as_module(python_launch_file_path)
    if not hasattr(made, "generate_launch_description"):
        raise RuntimeError("no generate_launch_description()")
    description: LaunchDescription = made.generate_launch_description()
    return description
