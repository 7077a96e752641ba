"""Certificate authority of one run, and a certificate for every machine of the row, for mutual TLS.

I/O. openssl writes PEM files. Keys are ECDSA P-256 as in our own certificates, valid for a day.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from lab.machine import LabMachine

_NEW: Final = ("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-noenc", "-days", "1")
_ROOT: Final = ("basicConstraints=critical,CA:TRUE,pathlen:0", "keyUsage=critical,keyCertSign,cRLSign")
_HOST: Final = (
    "basicConstraints=critical,CA:FALSE", "keyUsage=critical,digitalSignature", "extendedKeyUsage=serverAuth,clientAuth"
)  # fmt: skip


def make_certificates(directory: Path, hosts: Mapping[str, Iterable[str]]) -> None:
    """Write ``ca.crt`` and, for each host, ``NAME.crt`` and ``NAME.key``, unless the directory is there.

    ``hosts``: IPv4 addresses by name.
    """
    if directory.exists():
        return
    directory.mkdir(mode=0o700)
    _make(directory, "ca", "bench root", _ROOT)
    for host, addresses in hosts.items():
        names = ",".join(f"IP:{each}" for each in addresses)
        _make(directory, host, host, (*_HOST, f"subjectAltName={names}"), "-CA", "ca.crt", "-CAkey", "ca.key")


def _make(directory: Path, name: str, subject: str, extensions: Iterable[str], *issuer: str) -> None:
    added = [word for each in extensions for word in ("-addext", each)]
    files = ("-keyout", f"{name}.key", "-out", f"{name}.crt")
    words = (*_NEW, "-config", "/dev/null", "-subj", f"/CN={subject}", *files, *issuer, *added)
    LabMachine(directory).output("openssl", *words)
