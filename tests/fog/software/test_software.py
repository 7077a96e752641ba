"""Software of rented machines: offered by the supervisor, fetched by the script that user data contains."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from fog.providers.cloud_init import Setup, placed, user_data
from fog.software.config import SoftwareConfig
from fog.software.offer import WORKSPACE, offered
from fog.software.server import SOFTWARE_FILE, SoftwareServer
from gdp.errors import LocalError

WHEEL = "nodes-1.0-py3-none-any.whl"


@dataclass
class Supply:
    """Server with a wheel and a workspace, and its clock."""

    config: SoftwareConfig
    folder: Path
    now_s: float = 1_000.0
    server: SoftwareServer = field(init=False)

    def __post_init__(self) -> None:
        listening = socket.create_server(("127.0.0.1", 0))
        url = f"https://127.0.0.1:{listening.getsockname()[1]}"
        self.server = SoftwareServer(listening, self.folder / "keys", self.config, url, lambda: self.now_s)

    def fetch(self, files: dict[str, bytes], to: Path) -> subprocess.CompletedProcess[str]:
        """Run the script of user data, as the machine does."""
        script = next(each for each in placed(files, Setup()) if each.path.endswith("fog-fetch"))
        described = self.folder / SOFTWARE_FILE
        described.write_bytes(files[SOFTWARE_FILE])
        argv = [sys.executable, "-I", "-", str(described), str(to)]
        return subprocess.run(
            argv, input=script.content.decode(), capture_output=True, text=True, timeout=60, check=False
        )


@pytest.fixture
def supply(tmp_path: Path) -> Iterator[Supply]:
    wheels, workspace = tmp_path / "wheels", tmp_path / "install"
    wheels.mkdir()
    (wheels / WHEEL).write_bytes(b"a wheel")
    (workspace / "lib").mkdir(parents=True)
    (workspace / "local_setup.bash").write_text("export A=1\n")
    (workspace / "lib" / "link").symlink_to("../local_setup.bash")
    made = Supply(SoftwareConfig(wheels=wheels, workspace=workspace), tmp_path)
    yield made
    made.server.close()


def test_a_machine_gets_every_file_and_pins_every_wheel(supply: Supply, tmp_path: Path) -> None:
    done = supply.fetch(supply.server.bundle_file(60.0), tmp_path / "got")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "got" / "wheels" / WHEEL).read_bytes() == b"a wheel"
    (line,) = (tmp_path / "got" / "requirements.txt").read_text().splitlines()
    assert line.startswith(f"{tmp_path / 'got' / 'wheels' / WHEEL} --hash=sha256:")
    assert contents(tmp_path / "got") == {
        "d-lib.tar.gz": ["lib", "lib/link"],
        "top.tar.gz": ["local_setup.bash"],
    }


def contents(got: Path) -> dict[str, list[str]]:
    """Return what is in each archive of a workspace."""
    found = {}
    for path in sorted((got / WORKSPACE).iterdir()):
        with tarfile.open(path) as archive:
            found[path.name] = archive.getnames()
    return found


def test_only_the_package_that_changed_is_packed_and_fetched_again(supply: Supply, tmp_path: Path) -> None:
    assert supply.fetch(supply.server.bundle_file(60.0), tmp_path / "got").returncode == 0
    before = {path.name: path.stat().st_ino for path in (tmp_path / "got" / WORKSPACE).iterdir()}
    (tmp_path / "install" / "local_setup.bash").write_text("export A=3\n")
    assert supply.fetch(supply.server.bundle_file(60.0), tmp_path / "got").returncode == 0
    after = {path.name: path.stat().st_ino for path in (tmp_path / "got" / WORKSPACE).iterdir()}
    assert [name for name in after if after[name] != before[name]] == ["top.tar.gz"]
    assert len(list((tmp_path / "keys" / WORKSPACE).iterdir())) == 3


def test_a_package_that_was_removed_is_removed_on_the_machine(supply: Supply, tmp_path: Path) -> None:
    assert supply.fetch(supply.server.bundle_file(60.0), tmp_path / "got").returncode == 0
    (tmp_path / "install" / "lib" / "link").unlink()
    (tmp_path / "install" / "lib").rmdir()
    assert supply.fetch(supply.server.bundle_file(60.0), tmp_path / "got").returncode == 0
    assert list(contents(tmp_path / "got")) == ["top.tar.gz"]


def test_a_damaged_file_on_the_machine_is_fetched_again(supply: Supply, tmp_path: Path) -> None:
    assert supply.fetch(supply.server.bundle_file(60.0), tmp_path / "got").returncode == 0
    (tmp_path / "got" / "wheels" / WHEEL).write_bytes(b"damaged")
    assert supply.fetch(supply.server.bundle_file(60.0), tmp_path / "got").returncode == 0
    assert (tmp_path / "got" / "wheels" / WHEEL).read_bytes() == b"a wheel"


def test_what_a_pattern_ignores_is_not_sent(supply: Supply, tmp_path: Path) -> None:
    workspace = tmp_path / "install"
    for path in ("lib/__pycache__/a.pyc", "lib/b.log", "docs/c.txt", "lib/docs/d.txt"):
        (workspace / path).parent.mkdir(parents=True, exist_ok=True)
        (workspace / path).write_text(path)
    (workspace / ".fogignore").write_text("# logs\n*.log\n/docs/*\n")
    assert supply.fetch(supply.server.bundle_file(60.0), tmp_path / "got").returncode == 0
    assert contents(tmp_path / "got") == {
        "d-docs.tar.gz": ["docs"],
        "d-lib.tar.gz": ["lib", "lib/docs", "lib/docs/d.txt", "lib/link"],
        "top.tar.gz": ["local_setup.bash"],
    }


def test_a_file_that_was_changed_on_its_way_is_not_used(supply: Supply, tmp_path: Path) -> None:
    files = supply.server.bundle_file(60.0)
    wheel = tmp_path / "wheels" / WHEEL
    wheel.write_bytes(b"another")  # after its hash was promised
    done = supply.fetch(files, tmp_path / "got")
    assert done.returncode != 0
    assert "is not the file that was promised" in done.stderr
    assert not (tmp_path / "got" / "wheels" / WHEEL).exists()


def test_another_server_is_not_trusted(supply: Supply, tmp_path: Path) -> None:
    other = Supply(supply.config, tmp_path / "other")
    files = supply.server.bundle_file(60.0)
    described = json.loads(files[SOFTWARE_FILE])
    described["url"] = json.loads(other.server.bundle_file(60.0)[SOFTWARE_FILE])["url"]
    done = supply.fetch({SOFTWARE_FILE: json.dumps(described).encode()}, tmp_path / "got")
    other.server.close()
    assert done.returncode != 0
    assert "CERTIFICATE_VERIFY_FAILED" in done.stderr


def test_a_url_expires(supply: Supply, tmp_path: Path) -> None:
    files = supply.server.bundle_file(60.0)
    supply.now_s += 61.0
    done = supply.fetch(files, tmp_path / "got")
    assert done.returncode != 0
    assert "404" in done.stderr


def test_a_url_without_the_servers_mark_gets_nothing(supply: Supply, tmp_path: Path) -> None:
    described = json.loads(supply.server.bundle_file(60.0)[SOFTWARE_FILE])
    described["url"] = described["url"][:-1] + ("0" if described["url"][-1] != "0" else "1")
    done = supply.fetch({SOFTWARE_FILE: json.dumps(described).encode()}, tmp_path / "got")
    assert "404" in done.stderr


def test_a_url_is_used_up_after_a_few_downloads(supply: Supply, tmp_path: Path) -> None:
    files = supply.server.bundle_file(60.0)
    codes = [supply.fetch(files, tmp_path / f"got{turn}").returncode for turn in range(9)]
    assert codes[:8] == [0] * 8
    assert codes[8] != 0


def test_a_machine_after_a_change_gets_the_new_files(supply: Supply, tmp_path: Path) -> None:
    (tmp_path / "wheels" / "more-1.0-py3-none-any.whl").write_bytes(b"more")
    done = supply.fetch(supply.server.bundle_file(60.0), tmp_path / "got")
    assert done.returncode == 0, done.stderr
    assert len((tmp_path / "got" / "requirements.txt").read_text().splitlines()) == 2


def test_a_url_works_after_a_restart_of_the_supervisor(supply: Supply, tmp_path: Path) -> None:
    files = supply.server.bundle_file(60.0)
    port = int(json.loads(files[SOFTWARE_FILE])["url"].split("/")[2].rpartition(":")[2])
    supply.server.close()
    listening = socket.create_server(("127.0.0.1", port))
    supply.server = SoftwareServer(listening, tmp_path / "keys", supply.config, "https://-", lambda: supply.now_s)
    assert supply.fetch(files, tmp_path / "got").returncode == 0


def test_the_same_files_make_the_same_list(supply: Supply, tmp_path: Path) -> None:
    (tmp_path / "install" / "local_setup.bash").touch()  # another time of change
    (tmp_path / "scratch").mkdir()
    digests = {offered(supply.config, tmp_path / "scratch").digest for _ in range(2)}
    assert len(digests) == 1
    (tmp_path / "install" / "local_setup.bash").write_text("export A=2\n")
    assert offered(supply.config, tmp_path / "scratch").digest not in digests


def test_a_folder_without_wheels_says_how_to_fill_it(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match="fog wheels"):
        offered(SoftwareConfig(wheels=tmp_path), tmp_path)


def test_a_hundred_wheels_do_not_make_user_data_larger(supply: Supply, tmp_path: Path) -> None:
    small = len(user_data(supply.server.bundle_file(60.0), Setup()))
    for number in range(100):
        (tmp_path / "wheels" / f"part{number}-1.0-py3-none-any.whl").write_bytes(b"%d" % number)
    assert abs(len(user_data(supply.server.bundle_file(60.0), Setup())) - small) < 64
