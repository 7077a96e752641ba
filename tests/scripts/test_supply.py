"""Locks, bill of materials and signed checksums: installed and released files are the intended ones."""

from __future__ import annotations

import json
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import uuid
import zipfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pytest
import release
import sbom
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from sbom import LockError, Pin, read_lock

from gdp.stores.issue import make_owner
from tests.draws import IS_LONG
from tests.pages import ROOT

LOCKS = {path.name: read_lock(path) for path in sorted((ROOT / "requirements").glob("*.lock"))}
HASH = "0a" * 32
PINNED = f"alpha==1.2 \\\n    --hash=sha256:{HASH}\nbeta==2.0 ; python_version >= '3' --hash=sha256:{HASH}\n"

needs_toml = pytest.mark.skipif(sys.version_info < (3, 11), reason="this Python has no tomllib")


@pytest.fixture
def project() -> dict[str, Any]:
    """Return the project's table of pyproject.toml."""
    tomllib = pytest.importorskip("tomllib", reason="this Python has no tomllib")
    table: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return table


def _has_backend() -> bool:
    try:
        return int(version("setuptools").partition(".")[0]) >= 77
    except PackageNotFoundError:
        return False


needs_backend = pytest.mark.skipif(not _has_backend(), reason="setuptools is older than requirements/dev.lock has it")


def lock(folder: Path, text: str = PINNED) -> Path:
    path = folder / "test.lock"
    path.write_text(text)
    return path


def install(folder: Path, name: str, at: str, meta: str) -> None:
    """Write the metadata of an installed package."""
    info = folder / f"{name}-{at}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {at}\n{meta}")


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Folder of packages in which alpha and beta are installed as pinned."""
    folder = tmp_path / "site"
    install(folder, "alpha", "1.2", "License-Expression: MIT\nRequires-Dist: Beta>=1\n")
    install(folder, "beta", "2.0", "Classifier: License :: OSI Approved :: BSD License\n")
    return folder


def test_every_lock_is_a_part_of_the_one_for_development() -> None:
    assert LOCKS.keys() == {"build.lock", "dev.lock", "ros2.lock", "run.lock"}
    known = {(pin.name, pin.version): pin.hashes for pin in LOCKS["dev.lock"]}
    for name, pins in LOCKS.items():
        assert pins
        assert [pin for pin in pins if known.get((pin.name, pin.version)) != pin.hashes] == [], name


@pytest.mark.parametrize(("name", "extras"), [("run.lock", ()), ("ros2.lock", ("ros2",)), ("dev.lock", None)])
def test_each_dependency_is_pinned_in_a_version_that_is_allowed(
    project: dict[str, Any], name: str, extras: tuple[str, ...] | None
) -> None:
    optional = project["optional-dependencies"]
    chosen = optional if extras is None else extras
    wanted = [*project["dependencies"], *(each for extra in chosen for each in optional[extra])]
    versions: dict[str, list[str]] = {}
    for pin in LOCKS[name]:
        versions.setdefault(pin.name, []).append(pin.version)
    for requirement in map(Requirement, wanted):
        if requirement.name == project["name"]:
            continue  # an extra that includes another extra of this project
        pinned = versions.get(canonicalize_name(requirement.name), [])
        assert pinned, requirement
        assert all(requirement.specifier.contains(each, prereleases=True) for each in pinned), requirement


def test_a_changed_dependency_makes_each_lock_outdated(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "requirements", tmp_path / "requirements")
    (tmp_path / "scripts").mkdir()
    shutil.copy(ROOT / "scripts" / "lock.sh", tmp_path / "scripts")
    text = (ROOT / "pyproject.toml").read_text()
    outdated = []
    for written in (text, text.replace('"typer>=', '"typer>=99.')):
        (tmp_path / "pyproject.toml").write_text(written)
        checked = subprocess.run(
            ["scripts/lock.sh", "--check"], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        outdated.append((checked.returncode, [line.partition(":")[0] for line in checked.stderr.splitlines()]))
    assert outdated == [(0, []), (1, [f"requirements/{name}" for name in LOCKS])]


def test_a_switch_needs_no_ros_package_and_no_scapy(project: dict[str, Any]) -> None:
    names = {canonicalize_name(Requirement(each).name) for each in project["dependencies"]}
    assert not names & {"scapy", "rosbags", "numpy", "apsw", "lz4", "backports-zstd"}


def test_setup_installs_by_hash_alone() -> None:
    lines = [line.strip() for line in (ROOT / "scripts/setup.sh").read_text().splitlines() if "pip install" in line]
    (installs,) = (line for line in lines if line.startswith("pip()"))
    assert "--no-deps" in installs
    assert [line for line in lines if "venv/bin/python" in line and line != installs] == []
    calls = re.findall(r"! pip ([^|;]+?)(?: \|\||;)", (ROOT / "scripts/setup.sh").read_text())
    assert [call.split()[0] for call in calls] == ["--require-hashes", "--require-hashes", "--no-build-isolation"]


@pytest.mark.parametrize(
    "line",
    ["alpha", "alpha==1.2", f"alpha>=1 --hash=sha256:{HASH}", "alpha==1 --hash=md5:00", f"-e . --hash=sha256:{HASH}"],
)
def test_a_lock_with_a_line_that_pins_nothing_is_refused(line: str, tmp_path: Path) -> None:
    with pytest.raises(LockError, match=r"test\.lock:4: "):
        read_lock(lock(tmp_path, f"{PINNED}{line}\n"))


def test_a_bill_lists_each_pin_with_its_hashes_licence_and_needs(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(site))
    pins = [*read_lock(lock(site)), Pin("gamma", "3", "", frozenset({HASH}))]
    document = sbom.bill(pins, "gdp-ros", "0.1.0", ["alpha"], 0)
    parts = {each["name"]: each for each in document["components"]}
    assert (document["bomFormat"], document["specVersion"]) == ("CycloneDX", "1.6")
    assert list(parts) == ["alpha", "beta", "gamma"]
    assert parts["alpha"]["licenses"] == [{"expression": "MIT"}]
    assert parts["beta"]["licenses"] == [{"license": {"name": "BSD License"}}]
    assert "licenses" not in parts["gamma"]
    assert parts["alpha"]["externalReferences"][0]["hashes"] == [{"alg": "SHA-256", "content": HASH}]
    assert {each["ref"]: each["dependsOn"] for each in document["dependencies"]} == {
        "pkg:pypi/gdp-ros@0.1.0": ["pkg:pypi/alpha@1.2"],
        "pkg:pypi/alpha@1.2": ["pkg:pypi/beta@2.0"],
        "pkg:pypi/beta@2.0": [],
        "pkg:pypi/gamma@3": [],
    }
    assert document["metadata"]["timestamp"] == "1970-01-01T00:00:00+00:00"


@needs_toml
def test_the_bill_of_a_lock_is_whole_and_the_same_each_time(tmp_path: Path) -> None:
    outs = [tmp_path / "one.json", tmp_path / "two.json"]
    for out in outs:
        assert sbom.main(["--lock", str(ROOT / "requirements/run.lock"), "-o", str(out)]) == 0
    assert outs[0].read_bytes() == outs[1].read_bytes()
    document = json.loads(outs[0].read_text())
    refs = [each["bom-ref"] for each in document["components"]]
    assert sorted(refs) == sorted({f"pkg:pypi/{pin.name}@{pin.version}" for pin in LOCKS["run.lock"]})
    assert {ref for each in document["dependencies"] for ref in each["dependsOn"]} <= set(refs)
    assert uuid.UUID(document["serialNumber"].removeprefix("urn:uuid:")).version == 5
    direct = next(each for each in document["dependencies"] if each["ref"].startswith("pkg:pypi/gdp-ros@"))
    assert any(each.startswith("pkg:pypi/cryptography@") for each in direct["dependsOn"])


@pytest.fixture
def signed(tmp_path: Path) -> tuple[Path, Path]:
    """Signed folder of two files, and the keys."""
    folder, keys = tmp_path / "dist", tmp_path / "keys"
    folder.mkdir()
    make_owner(keys)
    (folder / "a-1.whl").write_bytes(b"a wheel")
    (folder / "run.lock").write_text(PINNED)
    release.write_sums(folder)
    release.sign(folder, keys / "owner.key")
    return folder, keys


def verified(signed: tuple[Path, Path]) -> int:
    folder, keys = signed
    return release.main(["verify", "--key", str(keys / "owner.pub"), str(folder)])


def test_a_signed_release_verifies(signed: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert verified(signed) == 0
    assert capsys.readouterr().out.splitlines() == ["a-1.whl: verified", "run.lock: verified"]


@pytest.mark.parametrize("name", ["a-1.whl", "run.lock", "SHA256SUMS", "SHA256SUMS.sig"])
@pytest.mark.parametrize("how", ["changed", "deleted"])
def test_a_release_with_a_file_changed_or_deleted_does_not_verify(
    signed: tuple[Path, Path], name: str, how: str
) -> None:
    path = signed[0] / name
    if how == "deleted":
        path.unlink()
    else:
        data = bytearray(path.read_bytes())
        data[-2] ^= 1
        path.write_bytes(data)
    assert verified(signed) == 1


def test_a_file_that_was_added_does_not_pass_for_a_part_of_the_release(
    signed: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    (signed[0] / "b-1.whl").write_bytes(b"another wheel")
    assert verified(signed) == 1
    assert "b-1.whl is not listed" in capsys.readouterr().err


def test_a_release_signed_by_another_does_not_verify(signed: tuple[Path, Path], tmp_path: Path) -> None:
    make_owner(tmp_path / "other")
    release.sign(signed[0], tmp_path / "other/owner.key")
    assert verified(signed) == 1


@pytest.mark.parametrize("line", ["{0}  ../a-1.whl", "{0}  a-1.whl\n{0}  a-1.whl", "{0} *a-1.whl", ""])
def test_checksums_that_mean_something_else_are_not_signed(signed: tuple[Path, Path], line: str) -> None:
    folder, keys = signed
    (folder / "SHA256SUMS").write_text(line.format(HASH) + "\n")
    assert release.main(["sign", "--key", str(keys / "owner.key"), str(folder)]) == 1


def test_a_key_that_others_can_read_signs_nothing(
    signed: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, keys = signed
    (keys / "owner.key").chmod(0o644)
    assert release.main(["sign", "--key", str(keys / "owner.key"), str(folder)]) == 2
    assert "owner.key" in capsys.readouterr().err


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_openssl_and_sha256sum_verify_a_release_too(signed: tuple[Path, Path]) -> None:
    folder, keys = signed
    words = ["openssl", "dgst", "-sha256", "-verify", str(keys / "owner.pub"), "-signature"]
    words += ["SHA256SUMS.sig", "SHA256SUMS"]
    assert subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True).stdout.strip() == "Verified OK"
    subprocess.run(["sha256sum", "--check", "--strict", "SHA256SUMS"], cwd=folder, capture_output=True, check=True)


@needs_toml
@needs_backend
def test_a_commit_is_built_to_the_same_bytes_each_time_without_what_is_not_committed(tmp_path: Path) -> None:
    root = tmp_path / "root"
    (root / "small").mkdir(parents=True)
    (root / "small/__init__.py").write_text("WORD = 'committed'\n")
    (root / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["setuptools"]\nbuild-backend = "setuptools.build_meta"\n'
        '[project]\nname = "small"\nversion = "1"\ndependencies = ["alpha"]\n[tool.setuptools]\npackages = ["small"]\n'
    )
    (root / "requirements").mkdir()
    (root / "requirements/run.lock").write_text(PINNED)
    shutil.copytree(ROOT / "scripts/supply", root / "scripts/supply", ignore=shutil.ignore_patterns("__pycache__"))
    git = ["git", "-C", str(root), "-c", "user.name=a", "-c", "user.email=a@example.org"]
    for words in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "first"]):
        subprocess.run([*git, *words], check=True)
    (root / "small/__init__.py").write_text("WORD = 'not committed'\n")
    for out in ("one", "two"):
        release.build(tmp_path / out, root)
    names = ["SHA256SUMS", "run.lock", "sbom.cdx.json", "small-1-py3-none-any.whl", "small-1.tar.gz"]
    assert sorted(path.name for path in (tmp_path / "one").iterdir()) == names
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), name
    with zipfile.ZipFile(tmp_path / "one/small-1-py3-none-any.whl") as wheel:
        assert wheel.read("small/__init__.py") == b"WORD = 'committed'\n"
    with tarfile.open(tmp_path / "one/small-1.tar.gz") as sdist:
        assert {(each.uid, each.uname, each.mode & 0o022) for each in sdist.getmembers()} == {(0, "", 0)}
    with pytest.raises(release.ReleaseError, match="not empty"):
        release.build(tmp_path / "one", root)


@needs_toml
@needs_backend
@pytest.mark.skipif(not (ROOT / "gdp/burst/core.abi3.so").exists(), reason="no compiler built the burst core here")
def test_the_release_of_this_commit_has_the_burst_core_and_passes_twine(tmp_path: Path) -> None:
    """That each build gives the same bytes is shown by a small one, and by night by this one too."""
    twine = pytest.importorskip("twine.commands.check", reason="twine of the extra `dev` is not installed")
    if subprocess.run(["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, check=False).returncode:
        pytest.skip("this is no clone: a release is built from a commit")
    release.build(tmp_path / "one")
    files = sorted((tmp_path / "one").iterdir())
    if IS_LONG:
        release.build(tmp_path / "two")
        assert [path.read_bytes() for path in files] == [(tmp_path / "two" / path.name).read_bytes() for path in files]
    (wheel,), (sdist,) = (tmp_path / "one").glob("*.whl"), (tmp_path / "one").glob("*.tar.gz")
    assert twine.check([str(wheel), str(sdist)], strict=True) is False
    assert wheel.name.endswith(f"-cp310-abi3-linux_{platform.machine()}.whl")
    with zipfile.ZipFile(wheel) as archive:
        (about,) = (name for name in archive.namelist() if name.endswith(".dist-info/WHEEL"))
        assert "Root-Is-Purelib: false" in archive.read(about).decode().splitlines()
        compiled = [name for name in archive.namelist() if name.endswith((".so", ".pyd", ".dll"))]
        assert compiled == ["gdp/burst/core.abi3.so"]
        assert archive.read(compiled[0]).startswith(b"\x7fELF")
        units = {name for name in archive.namelist() if name.endswith(".service")}
        assert units >= {f"gdp/enrolment/service/gdp-{each}.service" for each in ("switch", "rib", "proxy", "fog")}
    with tarfile.open(sdist) as sources:
        names = {name.partition("/")[2] for name in sources.getnames()}
    assert {f"gdp/burst/{name}" for name in ("core.c", "core.h", "Makefile")} <= names
    assert "gdp/burst/core.abi3.so" not in names
    document = json.loads((tmp_path / "one/sbom.cdx.json").read_text())
    assert (document["bomFormat"], document["specVersion"]) == ("CycloneDX", "1.6")
    stated = {line.split("  ")[1] for line in (tmp_path / "one/SHA256SUMS").read_text().splitlines()}
    assert stated == {path.name for path in files} - {"SHA256SUMS"}
