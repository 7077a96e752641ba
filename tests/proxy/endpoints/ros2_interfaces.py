"""Interface packages of ROS 2 that have no wheels, built from their definitions with the generators that have some."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.proxy.endpoints.ros2_net import needs

COMPOSITION = {
    "srv/ListNodes.srv": "---\nstring[] full_node_names\nuint64[] unique_ids\n",
    "srv/LoadNode.srv": """string package_name
string plugin_name
string node_name
string node_namespace
uint8 log_level
string[] remap_rules
rcl_interfaces/Parameter[] parameters
rcl_interfaces/Parameter[] extra_arguments
---
bool success
string error_message
string full_node_name
uint64 unique_id
""",
    "srv/UnloadNode.srv": "uint64 unique_id\n---\nbool success\nstring error_message\n",
}
TF2 = {"msg/TFMessage.msg": "geometry_msgs/TransformStamped[] transforms\n"}
_GENERATORS = """rosidl_generator_type_description rosidl_generator_c rosidl_typesupport_introspection_c
rosidl_typesupport_fastrtps_c rosidl_typesupport_c rosidl_generator_py"""
_PACKAGE = """<?xml version="1.0"?>
<package format="3">
  <name>{name}</name><version>0.0.0</version><description>of tests</description>
  <maintainer email="test@example.org">tests</maintainer><license>none</license>
  {depends}<member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""
# The Python libraries of wheels name the include folder of the machine that built them.
_BUILD = """cmake_minimum_required(VERSION 3.20)
project({name})
find_package(ament_cmake REQUIRED)
foreach(each rosidl_cmake rosidl_adapter {generators})
  find_package(${{each}} REQUIRED)
endforeach()
foreach(each builtin_interfaces service_msgs {packages})
  find_package(${{each}} REQUIRED)
  set_target_properties(${{each}}::${{each}}__rosidl_generator_py PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "")
endforeach()
rosidl_generate_interfaces({name} {files} DEPENDENCIES {packages})
ament_package()
"""


class Interfaces:
    """Built packages, in a folder that takes some seconds to fill.

    Attributes:
        environment: by which a new process finds them.
        load: what it executes before it uses them.
    """

    def __init__(self, folder: Path) -> None:
        needs("rcl_interfaces", "geometry_msgs", "ament_package", "catkin_pkg")
        if shutil.which("cmake") is None or shutil.which("c++") is None:
            pytest.skip("cmake or a compiler of C++ is not installed: interface packages cannot be built")
        self._folder = folder
        builds = [
            self._start("composition_interfaces", COMPOSITION, "rcl_interfaces"),
            self._start("tf2_msgs", TF2, "std_msgs geometry_msgs"),
        ]
        for each in builds:
            output, _ = each.communicate()
            assert each.returncode == 0, output
        (self._modules,) = folder.glob("lib/python*/site-packages")
        paths = os.pathsep.join(filter(None, (str(self._modules), os.environ.get("PYTHONPATH"))))
        self.environment = {"PYTHONPATH": paths}
        self.load = f"import ctypes, glob\n[ctypes.CDLL(each) for each in glob.glob({f'{folder}/lib/*.so'!r})]"

    def use(self, patch: pytest.MonkeyPatch) -> None:
        """Let this process find them; their libraries stay loaded."""
        patch.syspath_prepend(str(self._modules))
        for library in self._folder.glob("lib/*.so"):
            ctypes.CDLL(str(library))

    def _start(self, name: str, definitions: Mapping[str, str], packages: str) -> subprocess.Popen[str]:
        source = self._folder / f"source_{name}"
        for path, text in definitions.items():
            (source / path).parent.mkdir(parents=True, exist_ok=True)
            (source / path).write_text(text)
        depends = "".join(f"<depend>{each}</depend>" for each in packages.split())
        (source / "package.xml").write_text(_PACKAGE.format(name=name, depends=depends))
        text = _BUILD.format(name=name, generators=_GENERATORS, packages=packages, files=" ".join(definitions))
        (source / "CMakeLists.txt").write_text(text)
        prefix, wheels = sys.prefix, sysconfig.get_path("platlib")
        known = {
            "AMENT_PREFIX_PATH": prefix,
            "CMAKE_PREFIX_PATH": prefix,
            "LD_LIBRARY_PATH": f"{prefix}/lib",
            "PATH": f"{prefix}/bin{os.pathsep}{os.environ['PATH']}",
        }
        options = [
            f"-DPython3_EXECUTABLE={sys.executable}",
            f"-DCMAKE_INSTALL_PREFIX={self._folder}",
            f"-DCMAKE_INSTALL_RPATH=$ORIGIN;{self._folder}/lib;{wheels}",
        ]
        make = (
            f"cmake -S {source} -B {source}/build {shlex.join(options)} && cmake --build {source}/build -t install -j2"
        )
        return subprocess.Popen(
            make, shell=True, text=True, env=os.environ | known, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
