"""Loader of launch files."""

from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader


def load_python_launch_file_as_module(python_launch_file_path):
    loader = SourceFileLoader("python_launch_file", python_launch_file_path)
    made = module_from_spec(spec_from_loader(loader.name, loader))
    loader.exec_module(made)
    return made


def get_launch_description_from_python_launch_file(python_launch_file_path):
    made = load_python_launch_file_as_module(python_launch_file_path)
    if not hasattr(made, "generate_launch_description"):
        raise RuntimeError("no generate_launch_description()")
    return made.generate_launch_description()
