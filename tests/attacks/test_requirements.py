"""Packages that a machine installs: none by name alone, because anyone may take a name on a public index."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from pydantic import ValidationError

from fog.providers.cloud_init import Setup, placed
from fog.site import SiteConfig
from gdp.errors import ConfigError, LocalError
from tests.fog.test_site import border
from tests.pages import ROOT

HASH = "0a" * 32


def installs(setup: Setup) -> dict[str, str]:
    return {file.path: file.content.decode() for file in placed({}, setup)}


def test_a51_no_name_is_installed_by_default() -> None:
    files = installs(Setup())
    assert "gdp-ros" not in "".join(files.values())
    assert "pip install" not in files["/usr/local/sbin/fog-install"]


def test_a51_a_site_whose_machines_install_nothing_is_refused_before_anything_costs(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"aws\.setup\.requirements or requirements_file"):
        SiteConfig.load(border(tmp_path, "provider: aws", "aws: {disk_gib: 9}"))


@pytest.mark.parametrize(
    "requirement",
    [
        "gdp-ros[ros2]",
        "gdp-ros==0.1.0",
        "gdp-ros>=0.1 --hash=sha256:" + HASH,
        "https://example.org/gdp_ros.whl",
        "https://example.org/gdp_ros.whl#sha256=0a",
        f"http://example.org/gdp_ros.whl#sha256={HASH}",
        f"--index-url=https://example.org a==1 --hash=sha256:{HASH}",
        f"a==1 --hash=sha256:{HASH}\nb",
        f"a==1 --hash=sha256:{HASH}\n",
        f"a==1 --hash=md5:{HASH}",
        "./a.whl",
    ],
)
def test_a51_a_requirement_without_its_hash_is_refused(requirement: str, tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match="sha256"):
        Setup(requirements=(requirement,))
    if not requirement.startswith("--"):
        path = tmp_path / "requirements.txt"
        path.write_text(f"# ours\na==1 --hash=sha256:{HASH}\n{requirement.rstrip()}\nb\n")
        with pytest.raises(LocalError, match=rf"{path}:[34]: "):
            placed({}, Setup(requirements_file=path))


@pytest.mark.parametrize(
    "requirement",
    [
        f"https://example.org/gdp_ros-0.1.0-py3-none-any.whl#sha256={HASH}",
        f"gdp-ros[ros2] @ https://example.org/gdp_ros-0.1.0-py3-none-any.whl#sha256={HASH}",
        f"a-b.c==1.0+local --hash=sha256:{HASH} --hash=sha256:{HASH}",
        f'a==1; python_version < "3.12" --hash=sha256:{HASH}',
    ],
)
def test_a51_what_is_pinned_is_installed_with_hashes_required(requirement: str) -> None:
    files = installs(Setup(requirements=(requirement,)))
    assert "pip install --no-input --quiet --require-hashes" in files["/usr/local/sbin/fog-install"]
    assert files["/etc/fog-requirements.txt"] == f"{requirement}\n"


def test_a51_a_file_as_tools_write_it_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "requirements.txt"
    text = f"--only-binary :all:\n\na==1 \\\n    --hash=sha256:{HASH} \\\n    --hash=sha256:{HASH}\n    # via x\n"
    path.write_text(text)
    assert installs(Setup(requirements_file=path))["/etc/fog-requirements.txt"].startswith(text.rstrip())


@pytest.mark.parametrize("content", [b"", b"# nothing\n", b"\xff", b"-r other.txt\n", b"-e .\n"])
def test_a51_a_file_of_other_lines_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "requirements.txt"
    path.write_bytes(content)
    with pytest.raises(LocalError, match=str(path)):
        placed({}, Setup(requirements_file=path))


@pytest.mark.parametrize("is_right", [True, False])
def test_a51_pip_refuses_a_wheel_that_was_exchanged(tmp_path: Path, is_right: bool) -> None:
    wheel = tmp_path / "nodes-1-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("nodes.py", "")
        archive.writestr("nodes-1.dist-info/METADATA", "Metadata-Version: 2.1\nName: nodes\nVersion: 1\n")
        archive.writestr("nodes-1.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr("nodes-1.dist-info/RECORD", "")
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest() if is_right else HASH
    listed = tmp_path / "requirements.txt"
    listed.write_text(installs(Setup(requirements=(f"{wheel.as_uri()}#sha256={digest}",)))["/etc/fog-requirements.txt"])
    pip = [sys.executable, "-m", "pip", "install", "--no-input", "--no-index", "--disable-pip-version-check"]
    if subprocess.run([*pip[:3], "--version"], capture_output=True, check=False).returncode:
        pytest.skip("pip is not installed")
    done = subprocess.run(
        [*pip, "--require-hashes", "--requirement", str(listed), "--target", str(tmp_path / "there")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode == 0) == is_right, done.stderr
    assert (tmp_path / "there" / "nodes.py").exists() == is_right


def test_z07_the_build_backend_is_the_one_of_its_lock() -> None:
    required = re.findall(r'^requires = \["(.+)"\]', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    locked = re.findall(r"^(\S+==\S+) ", (ROOT / "requirements/build.lock").read_text(), re.MULTILINE)
    assert len(locked) == 1
    assert required == locked
