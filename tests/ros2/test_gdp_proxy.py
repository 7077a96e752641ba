"""ROS 2 package ``gdp_proxy``: colcon builds it, and its program becomes the proxy with the parameters of a file."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import xml.etree.ElementTree as Xml
from hashlib import sha256
from pathlib import Path
from typing import Final

import pytest

from lab.debian import cache_folder
from tests.pages import ROOT

PACKAGE: Final = ROOT / "ros2" / "gdp_proxy"
COLCON: Final = (  # setuptools: the newest that colcon accepts
    "catkin-pkg==1.1.1", "colcon-cmake==0.2.30", "colcon-core==0.21.3", "colcon-library-path==0.2.1",
    "colcon-pkg-config==0.1.0", "colcon-python-setup-py==0.2.9", "colcon-recursive-crawl==0.2.3", "colcon-ros==0.5.0",
    "colcon-test-result==0.3.8", "distlib==0.4.4", "setuptools==79.0.1",
)  # fmt: skip
PATIENCE_S: Final = 120.0


def colcon() -> Path:
    """Return the command of an environment of its own, kept between runs, which also sees this one's packages."""
    recipe = sha256(repr((COLCON, sys.version, sys.prefix)).encode()).hexdigest()[:12]
    folder = cache_folder() / f"colcon-{recipe}"
    if not (folder / "made").exists():
        shutil.rmtree(folder, ignore_errors=True)
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
        python = str(folder / "bin" / "python")
        words = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", *COLCON]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            pytest.skip(f"colcon cannot be installed: {done.stderr.strip().splitlines()[-1]}")
        where = subprocess.run(
            [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
            check=True,
            capture_output=True,
            text=True,
        )
        lines = [sysconfig.get_path("purelib"), str(ROOT)]
        Path(where.stdout.strip(), "tested.pth").write_text("\n".join([*lines, ""]))
        (folder / "made").touch()
    return folder / "bin" / "colcon"


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a workspace that colcon has built."""
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    folder = tmp_path_factory.mktemp("workspace")
    shutil.copytree(PACKAGE, folder / "src" / "gdp_proxy")
    words = [str(colcon()), "--log-base", str(folder / "log"), "build", "--event-handlers", "console_direct-"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def run(workspace: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a shell that has sourced the workspace."""
    script = f'. {workspace}/install/local_setup.sh && exec "$@"'
    environment = {**os.environ, "AMENT_PREFIX_PATH": "", "COLCON_CURRENT_PREFIX": str(workspace / "install")}
    return subprocess.run(
        ["sh", "-c", script, "sh", *words],
        cwd=workspace,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


def program(workspace: Path) -> Path:
    """Return the program that ``ros2 run gdp_proxy proxy`` starts: the one in the package's lib folder."""
    return workspace / "install/gdp_proxy/lib/gdp_proxy/proxy"


def test_colcon_installs_the_package_where_ros2_finds_it(workspace: Path) -> None:
    share = workspace / "install/gdp_proxy/share"
    assert (share / "ament_index/resource_index/packages/gdp_proxy").is_file()
    for each in ("package.xml", "launch/proxy.launch.py", "config/proxy.params.yaml"):
        assert (share / "gdp_proxy" / each).is_file()
    index = "from ament_index_python import get_package_prefix; print(get_package_prefix('gdp_proxy'))"
    done = run(workspace, sys.executable, "-c", index)
    assert done.stdout.strip() == str(workspace / "install/gdp_proxy"), done.stderr
    assert os.access(program(workspace), os.X_OK)


def test_the_program_becomes_the_proxy_with_the_parameters_of_a_file(workspace: Path, tmp_path: Path) -> None:
    lab = [sys.executable, "-m", "gdp.cli.gdp", "lab", "robot"]
    subprocess.run(lab, cwd=tmp_path, check=True, capture_output=True)
    (tmp_path / "robot/proxy.yaml").write_text(
        "identity: proxy\ndomain: {root: proxy/root.crt}\ndelegations: proxy/delegations\niface: proxy0\n"
        "import:\n  - {name: /camera/image, type: sensor_msgs/msg/Image, owner: owner.pub}\n"
    )
    words = ["proxy.cli.delegate", "--owner", "owner", "robot/proxy.yaml"]
    subprocess.run([sys.executable, "-m", *words], cwd=tmp_path, check=True, capture_output=True)
    text = (PACKAGE / "config/proxy.params.yaml").read_text()
    text = text.replace("/etc/gdp/proxy.yaml", str(tmp_path / "robot/proxy.yaml")).replace(
        "check: false", "check: true"
    )
    (tmp_path / "params.yaml").write_text(text)
    done = run(workspace, str(program(workspace)), "--ros-args", "--params-file", str(tmp_path / "params.yaml"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "configuration good: proxy" in done.stdout


def test_a_missing_configuration_is_named(workspace: Path) -> None:
    done = run(workspace, str(program(workspace)))
    assert (done.returncode, done.stderr.strip().splitlines()[-1].partition(";")[0]) == (
        2,
        "gdp_proxy: config: required",
    )


def test_versions_of_the_package_are_those_of_the_project() -> None:
    version = Xml.parse(PACKAGE / "package.xml").findtext("version")
    assert f'version = "{version}"' in (ROOT / "pyproject.toml").read_text()
    assert f'version="{version}"' in (PACKAGE / "setup.py").read_text()
