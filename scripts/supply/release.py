#!/usr/bin/env python3
"""Release from a commit: build, SHA-256 of each file, signature, and verification.

    .venv/bin/python scripts/supply/release.py build --out dist
    .venv/bin/python scripts/supply/release.py sign --key keys/release/owner.key dist
    .venv/bin/python scripts/supply/release.py verify --key keys/release/owner.pub dist

``build`` takes the commit, not the work tree, so uncommitted changes are not in it. The same commit and the same
setuptools and compiler give the same bytes. The key is one of ``gdp keygen owner``: ECDSA P-256. The signature is DER
over the bytes of SHA256SUMS, so openssl and sha256sum verify it without this project and its packages. Exit: 0 done, 1
it does not verify, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import hashlib
import io
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from gdp.crypto.keys import SigningKey  # noqa: E402
from gdp.errors import LocalError, StatementError  # noqa: E402
from gdp.stores.files import read_private  # noqa: E402
from gdp.stores.keyring import load_public_key  # noqa: E402

SUMS = "SHA256SUMS"
SIGNATURE = "SHA256SUMS.sig"
LOCK = "requirements/run.lock"
# The wheel has the burst core, which serves every later Python of its architecture; the source archive has its source.
_BACKEND = """
import pathlib, setuptools, setuptools.build_meta as backend, subprocess, sys
out, options = sys.argv[1], None
backend.build_sdist(out)
if pathlib.Path("gdp/burst").exists():
    subprocess.run(["make", "--silent", "-C", "gdp/burst", f"PYTHON={sys.executable}"], check=True)
    pathlib.Path("MANIFEST.in").write_text("include gdp/burst/core.abi3.so\\n")
    setuptools.Distribution.has_ext_modules = lambda _: True
    options = {"--build-option": ["--py-limited-api=cp310"]}
backend.build_wheel(out, options)
"""


class ReleaseError(Exception):
    """Verification failed, or a file cannot be made; the text gives the reason."""


def build(out: Path, root: Path = ROOT) -> None:
    """Make sdist, wheel, SBOM, lock and SHA256SUMS of the commit in a new or empty folder.

    Raises ``ReleaseError``: the folder holds something, or a tool failed.
    """
    out.mkdir(parents=True, exist_ok=True)
    if any(out.iterdir()):
        raise ReleaseError(f"{out} is not empty")
    epoch = _run(["git", "-C", str(root), "log", "-1", "--format=%ct"]).strip()
    with _checked_out(root) as source, tempfile.TemporaryDirectory() as made:
        env = {**os.environ, "SOURCE_DATE_EPOCH": epoch, "PYTHONHASHSEED": "0"}
        _run([sys.executable, "-c", _BACKEND, made], cwd=source, env=env)
        (sdist,), (wheel,) = Path(made).glob("*.tar.gz"), Path(made).glob("*.whl")
        (out / sdist.name).write_bytes(_normalised(sdist, int(epoch)))
        shutil.copyfile(wheel, out / wheel.name)
        script, lock = source / "scripts/supply/sbom.py", source / LOCK
        _run([sys.executable, str(script), "--lock", str(lock), "-o", str(out / "sbom.cdx.json")], env=env)
        shutil.copyfile(lock, out / lock.name)
    write_sums(out)


def write_sums(folder: Path) -> None:
    """Write the SHA-256 of each file of a folder, in the format of sha256sum."""
    (folder / SUMS).write_text("".join(f"{line}\n" for line in _sums(folder)))


def sign(folder: Path, key: Path) -> None:
    """Sign a folder's SHA256SUMS, after checking it.

    Raises ``ReleaseError``: SHA256SUMS does not match the folder. Raises ``LocalError``: the key cannot be read, or
    others may read it.
    """
    _check_sums(folder)
    private = SigningKey.from_pem(read_private(key)).private
    (folder / SIGNATURE).write_bytes(private.sign((folder / SUMS).read_bytes(), ec.ECDSA(hashes.SHA256())))


def verify(folder: Path, key: Path) -> list[str]:
    """Return the names of the signed files, which are all files of the folder.

    Raises ``ReleaseError``: the signature, a hash or a name does not match, or a file is there that is not listed.
    Raises ``LocalError``: the key cannot be read.
    """
    public = load_public_key(key)
    try:
        public.verify_der(_read(folder / SIGNATURE), _read(folder / SUMS))
    except StatementError as error:
        raise ReleaseError(f"{folder / SUMS} is not signed by {key}") from error
    return _check_sums(folder)


def main(words: Sequence[str] | None = None) -> int:
    """Run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    building = commands.add_parser("build", help="make the files of a release")
    building.add_argument("--out", type=Path, required=True, help="a new or empty folder")
    signing = commands.add_parser("sign", help="sign SHA256SUMS")
    signing.add_argument("--key", type=Path, required=True, help="owner.key of gdp keygen owner")
    checking = commands.add_parser("verify", help="verify signature and hashes")
    checking.add_argument("--key", type=Path, required=True, help="owner.pub of the signer")
    for each in (signing, checking):
        each.add_argument("folder", type=Path)
    given = parser.parse_args(words)
    try:
        if given.command == "build":
            build(given.out)
        elif given.command == "sign":
            sign(given.folder, given.key)
        else:
            for name in verify(given.folder, given.key):
                print(f"{name}: verified")
    except LocalError as error:
        print(f"release: {error}", file=sys.stderr)
        return 2
    except ReleaseError as error:
        print(f"release: {error}", file=sys.stderr)
        return 1
    return 0


def _sums(folder: Path) -> list[str]:
    """Return the lines of a folder's SHA256SUMS, by name."""
    paths = sorted(path for path in folder.iterdir() if path.name not in (SUMS, SIGNATURE))
    return [f"{hashlib.sha256(_read(path)).hexdigest()}  {path.name}" for path in paths]


def _check_sums(folder: Path) -> list[str]:
    """Return the names of a folder's files, if SHA256SUMS states each of them correctly, and no other.

    Raises ``ReleaseError``: otherwise.
    """
    present, stated = _sums(folder), _read(folder / SUMS).decode(errors="replace").splitlines()
    for line in stated:
        if line not in present:
            raise ReleaseError(f"{line.partition('  ')[2] or line} is missing, or not the file that {SUMS} states")
    for line in present:
        if line not in stated:
            raise ReleaseError(f"{line.partition('  ')[2]} is not listed in {SUMS}")
    if not present or stated != present:
        raise ReleaseError(f"{folder / SUMS}: expected a line for each file, by name, and one file or more")
    return [line.partition("  ")[2] for line in present]


@contextlib.contextmanager
def _checked_out(root: Path) -> Iterator[Path]:
    """Yield a folder with the files of the commit, with the modes of umask 022."""
    words = ["git", "-C", str(root), "-c", "tar.umask=022", "archive", "--format=tar", "HEAD"]
    archive = subprocess.run(words, capture_output=True, check=False)
    if archive.returncode:
        raise ReleaseError(archive.stderr.decode(errors="replace").strip())
    with tempfile.TemporaryDirectory() as folder, tarfile.open(fileobj=io.BytesIO(archive.stdout)) as tar:
        tar.extraction_filter = getattr(tarfile, "tar_filter", None)  # the archive is of our own git
        tar.extractall(folder)
        yield Path(folder)


def _normalised(sdist: Path, epoch_s: int) -> bytes:
    """Return a source archive without the differences between two builds: times, owners, order."""
    packed = io.BytesIO()
    with (
        tarfile.open(sdist) as old,
        gzip.GzipFile(filename="", fileobj=packed, mode="wb", mtime=epoch_s) as zipped,
        tarfile.open(fileobj=zipped, mode="w", format=tarfile.PAX_FORMAT) as new,
    ):
        for member in sorted(old.getmembers(), key=lambda each: each.name):
            member.mtime, member.uid, member.gid, member.uname, member.gname = epoch_s, 0, 0, "", ""
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            member.pax_headers = {}
            new.addfile(member, old.extractfile(member) if member.isfile() else None)
    return packed.getvalue()


def _run(words: Sequence[str], cwd: Path | None = None, env: Mapping[str, str] | None = None) -> str:
    done = subprocess.run(words, cwd=cwd, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ReleaseError(f"{words[0]}: {(done.stderr or done.stdout).strip()[-2_000:]}")
    return done.stdout


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ReleaseError(f"{path}: {error.strerror}") from error


if __name__ == "__main__":
    sys.exit(main())
