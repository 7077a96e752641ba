"""User data of a rented machine at its first start."""

from __future__ import annotations

import base64
import gzip
import json
import os
import random
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest
import yaml

from fog.host.bundle import pack
from fog.machine import MachineBundle, Program
from fog.providers.cloud_init import (
    USER_DATA_MAX_BYTES,
    Setup,
    cloud_config,
    placed,
    shell_script,
    user_data,
)
from gdp.errors import LocalError

SCHEMA = Path(sys.prefix) / "share/cloud-init/schema.json"
FILES = pack(
    MachineBundle(
        {"keys/own.key": bytes(range(256)), "proxy.yaml": "rules: []  # käse\n".encode(), "a.txt": b"x: 'y'\n\ttab\n"},
        (Program("switch", ("gdp-switch", "--config", "{home}/switch.yaml"), ready="is up"),),
    )
)
HASH = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"
FULL = Setup(
    requirements=(
        f"https://example.org/gdp_ros-0.1.0-py3-none-any.whl#sha256={HASH}",
        f"my-nodes==1.0 --hash=sha256:{HASH}",
    ),
    packages=("libfcl-dev",),
)


def read_back(text: str) -> dict[str, tuple[bytes, int]]:
    """Return path -> content and mode, as cloud-init's write_files would write it."""
    entries = yaml.safe_load(text)["write_files"]
    found = {}
    for each in entries:
        content = each["content"].encode()
        assert each.get("encoding", "b64") == "b64"
        found[each["path"]] = (
            base64.b64decode(content) if "encoding" in each else content,
            int(each["permissions"], 8),
        )
    return found


@pytest.mark.parametrize("setup", [Setup(), FULL])
def test_the_schema_of_cloud_init_allows_it(setup: Setup) -> None:
    if not SCHEMA.is_file():
        pytest.skip("cloud-init's schema is not here: scripts/setup_cloud_schema.sh fetches it")
    jsonschema.validate(yaml.safe_load(cloud_config(FILES, setup)), json.loads(SCHEMA.read_text()))


def test_the_schema_of_cloud_init_would_notice() -> None:
    if not SCHEMA.is_file():
        pytest.skip("cloud-init's schema is not here: scripts/setup_cloud_schema.sh fetches it")
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({"runcmd": 7}, json.loads(SCHEMA.read_text()))


def test_it_is_a_cloud_config_that_installs_and_starts() -> None:
    text = cloud_config(FILES, FULL)
    assert text.startswith("#cloud-config\n")
    config = yaml.safe_load(text)
    assert set(config) == {"apt", "package_update", "packages", "write_files", "runcmd"}
    assert {"python3-venv", "libfcl-dev"} <= set(config["packages"])
    assert config["runcmd"][-1][4:] == ["fog-machine", "fog-log@switch"]
    install = read_back(text)["/usr/local/sbin/fog-install"][0].decode()
    assert "--require-hashes --requirement /etc/fog-requirements.txt" in install
    assert read_back(text)["/etc/fog-requirements.txt"][0].decode().splitlines() == list(FULL.requirements)


def test_user_data_is_small_and_the_same_each_time() -> None:
    data = user_data(FILES, FULL)
    assert data == user_data(FILES, FULL)
    assert len(data) < USER_DATA_MAX_BYTES
    assert gzip.decompress(data).decode() == cloud_config(FILES, FULL)


def test_too_much_for_ec2_is_refused_before_it_is_asked() -> None:
    with pytest.raises(LocalError, match="16384"):
        user_data({"model.onnx": random.Random(1).randbytes(20_000)}, Setup())


@pytest.mark.parametrize("path", ["/etc/passwd", "../shadow", "a/../../b"])
def test_a_file_outside_the_machines_folder_is_refused(path: str) -> None:
    with pytest.raises(LocalError, match="outside"):
        placed({path: b""}, Setup())


def test_the_script_comes_to_the_same_files(tmp_path: Path) -> None:
    root, asked = tmp_path / "root", tmp_path / "asked"
    root.mkdir()
    sudo = tmp_path / "sudo"  # executes file operations below `root`, records commands that would change the machine
    sudo.write_text(
        f'#!/bin/sh\nif [ "$1" = tar ]; then exec "$@" --directory {root}; fi\necho "$@" >> {asked}\n', encoding="ascii"
    )
    sudo.chmod(0o755)
    subprocess.run(
        ["bash", "-s"],
        input=shell_script(FILES, FULL).encode(),
        env={"PATH": f"{tmp_path}:{os.environ['PATH']}"},
        timeout=30,
        check=True,
    )
    for file in placed(FILES, FULL):
        there = root / file.path.lstrip("/")
        assert there.read_bytes() == file.content
        assert there.stat().st_mode & 0o777 == file.mode
    assert asked.read_text().splitlines()[-1].startswith("systemctl enable --now")


def test_the_installation_is_done_once_and_again_after_a_failure(tmp_path: Path) -> None:
    installs = next(file for file in placed(FILES, FULL) if file.path.endswith("fog-install")).content.decode()
    subprocess.run(["sh", "-n"], input=installs.encode(), check=True)
    assert installs.index("complete ] && exit 0") < installs.index("pip install") < installs.index("touch")


def test_a_repository_comes_with_its_key(tmp_path: Path) -> None:
    key = tmp_path / "ros.asc"
    key.write_text("-----BEGIN PGP PUBLIC KEY BLOCK-----\n")
    source = {"uri": "http://packages.ros.org/ros2/ubuntu", "suite": "noble", "key_file": key}
    setup = Setup.model_validate({"apt_sources": (source,), "source": ("/opt/ros/jazzy/setup.bash",)})
    written = {each.path: each.content.decode() for each in placed({}, setup)}
    (list_,) = (text for path, text in written.items() if path.endswith(".sources"))
    assert "URIs: http://packages.ros.org/ros2/ubuntu\nSuites: noble\nComponents: main\n" in list_
    assert list_.rpartition("Signed-By: ")[2].strip() in written
    assert "/opt/ros/jazzy/setup.bash" in written["/etc/systemd/system/fog-machine.service"]


def test_a_file_that_is_no_key_is_refused(tmp_path: Path) -> None:
    (tmp_path / "ros.asc").write_text("<html>")
    source = {"uri": "http://packages.ros.org/ros2/ubuntu", "suite": "noble", "key_file": tmp_path / "ros.asc"}
    with pytest.raises(LocalError, match="OpenPGP"):
        placed(FILES, Setup.model_validate({"apt_sources": (source,)}))
