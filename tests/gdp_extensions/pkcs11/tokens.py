"""SoftHSM token for one test: its folder, its configuration, its address."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

PIN = "1234"
MODULES = [Path("/usr/lib/softhsm/libsofthsm2.so"), Path("/usr/lib64/softhsm/libsofthsm2.so")]
WHY_NOT = "a token of SoftHSM needs the package softhsm2 and the extra pkcs11"


@dataclass(frozen=True)
class SoftToken:
    """Initialised token named ``test``."""

    module: Path
    configuration: Path

    def uri(self, label: str) -> str:
        return f"pkcs11:token=test;object={label}?module-path={self.module}"

    def forget(self) -> None:
        """Close this process's sessions, so that the next opening logs in."""
        import pkcs11

        pkcs11.unload(str(self.module))


@contextmanager
def soft_token(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SoftToken]:
    """Make a token; skip where SoftHSM or its binding is not installed."""
    pytest.importorskip("pkcs11", reason=WHY_NOT)
    module = next((each for each in MODULES if each.exists()), None)
    if module is None or shutil.which("softhsm2-util") is None:
        pytest.skip(WHY_NOT)
    (folder / "tokens").mkdir(parents=True)
    configuration = folder / "softhsm2.conf"
    configuration.write_text(f"directories.tokendir = {folder}/tokens\nobjectstore.backend = file\n")
    monkeypatch.setenv("SOFTHSM2_CONF", str(configuration))
    made = ["softhsm2-util", "--init-token", "--free", "--label", "test", "--pin", PIN, "--so-pin", PIN]
    subprocess.run(made, check=True, capture_output=True, timeout=60)
    token = SoftToken(module, configuration)
    token.forget()
    try:
        yield token
    finally:
        token.forget()
