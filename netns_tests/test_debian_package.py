"""Debian package and image: built without network; the package leaves no file, and the image's nodes run."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from hashlib import sha256
from pathlib import Path
from typing import Final

import pytest

from lab.debian import cache_folder, debian_root, why_not
from lab.machine import LabMachine
from lab.namespaces import Space
from tests.pages import ROOT

pytestmark = pytest.mark.netns

LOCKS: Final = ("run", "build")
INSIDE: Final = """\
set -eu
mount -t overlay overlay -o "lowerdir=$1,upperdir=$2/upper,workdir=$2/work" "$2/root"
mount -t proc proc "$2/root/proc"
mount --bind /dev "$2/root/dev"
exec chroot "$2/root" /bin/sh -eu -c "$3"
"""
NODES: Final = """\
{entry} > /tmp/log 2>&1 &
tries=0
until {health} > /tmp/health 2>&1; do
    tries=$((tries + 1))
    if [ $tries -gt 60 ] || ! kill -0 $!; then
        ls -l /srv/gdp
        cat /tmp/log /tmp/health
        exit 1
    fi
    sleep 0.2
done
kill -TERM $!
code=0
wait $! || code=$?
cat /tmp/log /tmp/health
echo ended with $code
"""  # the programs of the image, and its check of their health
LIST: Final = "find / -xdev -not -path '/var/lib/dpkg/*' -not -path '/var/log/*' -not -path '/proc*' | sort"
JOURNEY: Final = f"""\
{LIST} > /var/log/before
dpkg --install /srv/gdp-ros.deb > /var/log/install 2>&1 || {{ cat /var/log/install; exit 1; }}
cd /root
for each in gdp gdp-switch gdp-rib gdp-relay gdp-proxy gdp-replay fog; do
    $each --version
done
gdp lab robot --iface lo --json > /dev/null
gdp-switch --config robot/switch.yaml --check
gdp unit install robot --dry-run | grep ExecStart
ls /lib/systemd/system/gdp-*.service
dpkg --audit
rm -r robot lab owner
find /usr/lib/gdp-ros -name '*.pyc' | wc -l | grep -qvx 0
dpkg --purge gdp-ros > /var/log/purge 2>&1
cat /var/log/purge
{LIST} | diff /var/log/before - && echo nothing is left
"""


def why_no_build() -> str:
    if reason := why_not():
        return reason
    if shutil.which("dh") is None or shutil.which("dpkg-buildpackage") is None:
        return "needs debhelper and dpkg-dev: scripts/setup.sh --dev installs them"
    return ""


needs_debhelper = pytest.mark.skipif(bool(why_no_build()), reason=why_no_build() or "it can")


def pinned_wheels() -> Path:
    """Return a folder with the wheels of the locks, for the system's Python; they are kept between runs."""
    version = subprocess.run(
        ["/usr/bin/python3", "-c", "import sys; print('%d.%d' % sys.version_info[:2])"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    locks = [ROOT / "requirements" / f"{each}.lock" for each in LOCKS]
    digest = sha256(b"".join(each.read_bytes() for each in locks) + version.encode()).hexdigest()[:12]
    folder = cache_folder() / f"locked-{digest}"
    if not folder.exists():
        for older in cache_folder().glob("locked-*"):
            shutil.rmtree(older)
        fresh = cache_folder() / f"new-{os.getpid()}"
        for lock in locks:
            words = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes"]
            words += ["--python-version", version, "--only-binary=:all:", "--dest", str(fresh), "-r", str(lock)]
            subprocess.run(words, check=True, capture_output=True)
        fresh.rename(folder)
    return folder


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the package, built from the files that git knows."""
    folder = tmp_path_factory.mktemp("debian")
    known = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
    ).stdout
    source = folder / "source"
    for name in filter(None, known.decode().split("\0")):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, source / name)
    environment = {**os.environ, "GDP_WHEELS": str(pinned_wheels()), "GDP_COMPRESSION": "gzip"}
    environment |= {"PIP_NO_INDEX": "1", "PYTHONPATH": ""}
    done = subprocess.run(
        ["dpkg-buildpackage", "-us", "-uc", "-b"],
        cwd=source,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-3_000:] + done.stderr[-3_000:]
    (built,) = folder.glob("gdp-ros_*.deb")
    return built


@needs_debhelper
@pytest.mark.nightly
def test_the_package_is_installed_in_a_clean_debian_and_removed_without_a_trace(package: Path, tmp_path: Path) -> None:
    for each in ("upper/srv", "work", "root"):
        (tmp_path / each).mkdir(parents=True)
    shutil.copyfile(package, tmp_path / "upper/srv/gdp-ros.deb")
    words = ["unshare", "--mount", "sh", "-c", INSIDE, "inside", str(debian_root()), str(tmp_path), JOURNEY]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert "gdp 0.1.0" in lines
    assert any(each.startswith("configuration good: switch") for each in lines)
    assert any(each.startswith("ExecStart=/usr/lib/gdp-ros/bin/gdp-switch --config ") for each in lines)
    assert lines[-1] == "nothing is left"


@needs_debhelper
@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("lintian") is None, reason="needs lintian: apt-get install lintian")
def test_lintian_finds_nothing_that_is_not_overridden_with_a_reason(package: Path) -> None:
    words = ["lintian", "--allow-root", "--fail-on", "error,warning", str(package)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@needs_debhelper
@pytest.mark.nightly
def test_each_command_has_a_manual_page_and_completion_in_three_shells(package: Path) -> None:
    words = ["dpkg-deb", "--contents", str(package)]
    listing = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    files = {line.split()[5].removeprefix("./usr/") for line in listing.splitlines()}
    assert "share/zsh/vendor-completions/_gdp" in files
    for command in sorted(each.removeprefix("bin/") for each in files if each.startswith("bin/") and each != "bin/"):
        assert f"share/man/man1/{command}.1.gz" in files
        assert f"share/bash-completion/completions/{command}" in files
        assert f"share/fish/vendor_completions.d/{command}.fish" in files
    assert "share/man/man1/gdp-trace.1.gz" in files, "commands of a group have pages too"


class Images:
    """Store of images below a folder, which ``buildah`` uses instead of the one of this host."""

    def __init__(self, folder: Path) -> None:
        self._words = ["buildah", "--root", str(folder / "store"), "--runroot", str(folder / "run")]
        self._words += ["--storage-driver", "overlay"]

    def run(self, *words: str) -> str:
        """Run a command and return what it prints."""
        done = subprocess.run([*self._words, *words], capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
        return done.stdout.strip()


@needs_debhelper
@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("buildah") is None, reason="needs buildah: apt-get install buildah")
def test_the_image_runs_the_nodes_of_a_machine(package: Path, tmp_path: Path, space: Space) -> None:
    images = Images(tmp_path)
    context = tmp_path / "context"
    context.mkdir()
    shutil.copyfile(package, context / package.name)
    base = images.run("from", "scratch")
    images.run("add", "--quiet", base, f"{debian_root()}/", "/")
    images.run("commit", "--quiet", base, "localhost/base")
    words = ["--isolation", "chroot", "--format", "docker", "--build-arg", "BASE=localhost/base", "--tag", "gdp-ros"]
    images.run("bud", *words, "--file", str(ROOT / "packaging" / "Containerfile"), str(context))
    made = json.loads(images.run("inspect", "--type", "image", "gdp-ros"))["Docker"]["config"]
    assert (made["User"], made["Entrypoint"], made["Cmd"]) == ("gdp", ["gdp"], ["up", "/srv/gdp"])
    container = images.run("from", "gdp-ros")
    assert images.run("run", "--isolation", "chroot", container, "--", "gdp", "--version") == "gdp 0.1.0"
    assert images.run("run", "--isolation", "chroot", container, "--", "id", "-un") == "gdp"
    space.ip("link", "add", "cable", "type", "veth", "peer", "name", "far")
    space.ip("link", "set", "cable", "up")
    LabMachine(tmp_path).gdp("lab", "robot", "--iface", "cable")
    options = ["run", "--isolation", "chroot", "--user", "0", "--cap-add", "CAP_NET_ADMIN", "--cap-add", "CAP_NET_RAW"]
    options += ["--volume", f"{tmp_path / 'robot'}:/srv/gdp"]
    entry, health = shlex.join(made["Entrypoint"] + made["Cmd"]), shlex.join(made["Healthcheck"]["Test"][1:])
    shown = images.run(
        *options, container, "--", "timeout", "110", "sh", "-c", NODES.format(entry=entry, health=health)
    )
    assert re.search(r"^switch +\| switch .* is up", shown, re.MULTILINE), shown
    assert re.search(r"^role +switch$", shown, re.MULTILINE), shown
    assert shown.endswith("ended with 0")
    images.run("rm", "--all")


def test_the_package_has_the_version_of_the_project() -> None:
    first = (ROOT / "debian" / "changelog").read_text().partition("\n")[0]
    project = (ROOT / "pyproject.toml").read_text()
    assert f'version = "{first.partition("(")[2].partition(")")[0]}"' in project
