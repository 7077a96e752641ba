"""First-boot configuration of a rented machine: the files of its bundle, and a service that installs and runs it.

Sans-I/O.
Source: cloud-init's "cloud config" format (modules write_files, packages, runcmd), systemd.service(5); Amazon EC2
accepts at most 16 KiB of user data, before base64, and cloud-init reads it gzipped.

``cloud_config`` is for providers that accept user data, ``shell_script`` for those that only run a script as root; both
produce the same files. The output of programs goes to the journal and the console under their names, such as
``switch[712]: ...``; ``lines_of`` finds it there. Packages of pip are pinned by hash (``requirements``), because their
code can reach the machine's keys. A machine whose programs have ended powers itself off.
"""

from __future__ import annotations

import base64
import gzip
import inspect
import io
import shlex
import tarfile
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import yaml
from pydantic import AfterValidator, Field

from fog.host.bundle import BOOT_FILE, read_programs
from fog.host.managed_process import NODE_USER
from fog.providers.requirements import pinned, read_requirements
from fog.software import fetch
from fog.software.offer import WORKSPACE
from fog.software.server import SOFTWARE_FILE
from gdp.config.schema import ExistingFile, Section
from gdp.errors import LocalError
from gdp.stores.files import read_at_most

HOME: Final = "/var/lib/fog"
USER_DATA_MAX_BYTES: Final = 16 * 1024
_INSTALLED: Final = "/opt/fog"
_REQUIREMENTS: Final = "/etc/fog-requirements.txt"
_INSTALL: Final = "/usr/local/sbin/fog-install"
_FETCH: Final = "/usr/local/sbin/fog-fetch"
_SOFTWARE: Final = "/opt/fog-software"
_WORKSPACE: Final = "/opt/fog-workspace"
_APT: Final = "/etc/apt/sources.list.d/fog-{}.sources"
_APT_KEY: Final = "/etc/apt/keyrings/fog-{}.asc"
_KEY_MAX_BYTES: Final = 64 << 10
_PACKAGES: Final = ("python3-venv", "iproute2", "util-linux", "wireguard-go")  # the last where the kernel has none
_APT_CONFIG: Final = 'APT::Install-Recommends "false";\n'
_PRIVATE: Final = 0o600
_NODE_USER: Final = "fog-node"  # user account of the users' nodes, which cannot read the machine's keys
_NODE_HOME: Final = "/var/lib/fog-node"
_MAKE_USER: Final = (
    f"id -u {_NODE_USER} >/dev/null 2>&1 || useradd --system --user-group --shell /usr/sbin/nologin"
    f" --home-dir {_NODE_HOME} --create-home {_NODE_USER}"
)
# cloud-init keeps copies of the user data, with the machine's token; they have been used when this runs.
_SCRUB: Final = (
    "for each in /var/lib/cloud/instances/*; do\n"
    'rm -f "$each"/user-data.txt* "$each"/cloud-config.txt "$each"/obj.pkl\n'
    "done"
)
# The metadata service exposes user data with the machine's secrets, so only programs of root may reach it. Routing
# rules
# enforce this without a packet filter; DNS on that address (UDP) remains reachable.
_METADATA: Final = "".join(
    f"{ip} rule del pref 90 2>/dev/null || true\n"
    f"{ip} rule add pref 90 uidrange 1-4294967294 ipproto tcp dport 80 to {address} prohibit{otherwise}\n"
    for ip, address, otherwise in (("ip", "169.254.169.254", ""), ("ip -6", "fd00:ec2::254", " || true"))
)
# Source: systemd.exec(5), systemd.resource-control(5). Root without most capabilities: the service changes to
# the nodes' user (SETUID, SETGID, SETPCAP), ends their processes (KILL), and accesses ROS files of that user
# (DAC_OVERRIDE).
_FENCES: Final = f"""NoNewPrivileges=yes
CapabilityBoundingSet=CAP_NET_RAW CAP_NET_ADMIN CAP_BPF CAP_PERFMON CAP_SETUID CAP_SETGID CAP_SETPCAP CAP_KILL
CapabilityBoundingSet=CAP_DAC_OVERRIDE
ProtectSystem=strict
ReadWritePaths={HOME} -{_NODE_HOME}
ProtectHome=yes
PrivateTmp=yes
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
LockPersonality=yes
RestrictNamespaces=yes
RestrictSUIDSGID=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK AF_PACKET
SystemCallArchitectures=native
SystemCallFilter=@system-service bpf capset seccomp landlock_create_ruleset landlock_add_rule landlock_restrict_self
SystemCallErrorNumber=EPERM
MemoryMax=90%
TasksMax=16384
LimitNOFILE=65536
RuntimeDirectory=fog wireguard
RuntimeDirectoryMode=0700
"""
_CLOSE: Final = (
    ["chmod", "-R", "go-rwx", HOME],
    ["chmod", "go+x", HOME],  # so that nodes of another user reach the files that they read
    ["find", HOME, "-maxdepth", "1", "-name", "*.xml", "-exec", "chmod", "go+r", "{}", "+"],  # the middleware's profile
)
_LOG: Final = f"""[Unit]
Description=The log of a machine's program %i, for the journal and the console

[Service]
ExecStart=/usr/bin/tail --follow=name --retry --lines=0 {HOME}/logs/%i.log
SyslogIdentifier=%i
StandardOutput=journal+console
StandardError=null
Restart=on-failure
NoNewPrivileges=yes
CapabilityBoundingSet=
ProtectSystem=strict
ProtectHome=yes
PrivateTmp=yes
PrivateDevices=yes
RestrictAddressFamilies=AF_UNIX
SystemCallFilter=@system-service
MemoryMax=64M
TasksMax=4
LimitNOFILE=64

[Install]
WantedBy=multi-user.target
"""


class AptSource(Section):
    """Repository of packages, such as that of ROS."""

    uri: str = Field(pattern=r"^https?://[!-~]+$", description="URL of the repository.")
    suite: str = Field(pattern=r"^[A-Za-z0-9._/-]+$", description="Suite.")
    components: tuple[Annotated[str, Field(pattern=r"^[A-Za-z0-9._/-]+$")], ...] = Field(
        default=("main",), description="Components."
    )
    key_file: ExistingFile = Field(description="Signing key, ASCII-armoured.")


class Setup(Section):
    """Software that a machine installs in addition to its bundle and to the site's ``software``.

    There is no default for pip, because anyone could register an unused name on an index.
    """

    requirements: tuple[Annotated[str, AfterValidator(pinned)], ...] = Field(
        default=(), description="For pip, each with its hash: `URL#sha256=...` or `name==version --hash=sha256:...`."
    )
    requirements_file: ExistingFile | None = Field(default=None, description="The same as a requirements file.")
    apt_sources: tuple[AptSource, ...] = Field(default=(), description="Further repositories for apt, such as ROS's.")
    packages: tuple[str, ...] = Field(default=(), description="Packages for apt.")
    source: tuple[Annotated[str, Field(pattern=r"^/[A-Za-z0-9._/+-]+$")], ...] = Field(
        default=(), description="Shell scripts that are sourced before programs start."
    )

    @property
    def has_requirements(self) -> bool:
        """Return whether pip installs anything; otherwise the image contains ``/opt/fog``."""
        return bool(self.requirements) or self.requirements_file is not None


@dataclass(frozen=True, slots=True)
class Placed:
    """File of the machine, owned by root; ``path``: absolute path."""

    path: str
    content: bytes
    mode: int = _PRIVATE


def placed(files: Mapping[str, bytes], setup: Setup) -> list[Placed]:
    """Return all files to write on the machine.

    Args:
        files: packed bundle: path below the machine's folder -> content.

    Raises:
        LocalError: a path leads out of that folder, or the requirements file is not pinned by hash.
    """
    for path in files:
        if path.startswith("/") or ".." in path.split("/"):
            raise LocalError(f"a boot's file {path!r} lies outside the machine's folder")
    own = [Placed(f"{HOME}/{path}", content) for path, content in sorted(files.items())]
    own.append(Placed(_REQUIREMENTS, _requirements(setup), 0o644))
    own.append(Placed(_INSTALL, _install(setup, fetches=SOFTWARE_FILE in files).encode(), 0o755))
    if SOFTWARE_FILE in files:
        own.append(Placed(_FETCH, inspect.getsource(fetch).encode(), 0o755))
    for index, each in enumerate(setup.apt_sources):
        own.append(Placed(_APT_KEY.format(index), _key(each.key_file), 0o644))
        own.append(Placed(_APT.format(index), _apt(each, _APT_KEY.format(index)), 0o644))
    own.append(Placed("/etc/systemd/system/fog-machine.service", _service(setup).encode(), 0o644))
    own.append(Placed("/etc/systemd/system/fog-log@.service", _LOG.encode(), 0o644))
    return own


def cloud_config(files: Mapping[str, bytes], setup: Setup) -> str:
    """Return the machine's set-up as ``#cloud-config``. Text remains readable; other content is base64."""
    written: list[dict[str, str]] = []
    for file in placed(files, setup):
        entry = {"path": file.path, "permissions": f"{file.mode:04o}"}
        try:
            written.append({**entry, "content": file.content.decode("ascii")})
        except UnicodeDecodeError:
            packed = base64.b64encode(file.content).decode()
            written.append({**entry, "encoding": "b64", "content": packed})
    config = {
        "apt": {"preserve_sources_list": True, "conf": _APT_CONFIG},
        "package_update": True,
        "packages": [*_PACKAGES, *setup.packages],
        "write_files": written,
        "runcmd": [*_CLOSE, *(shlex.split(line) for line in _start(files))],
    }
    return "#cloud-config\n" + yaml.safe_dump(config, sort_keys=False, width=4096)


def user_data(files: Mapping[str, bytes], setup: Setup) -> bytes:
    """Return ``cloud_config`` in EC2's form: gzipped.

    Raises:
        LocalError: it exceeds EC2's limit, or a path of ``files`` leads out of the machine's folder.
    """
    data = gzip.compress(cloud_config(files, setup).encode(), mtime=0)
    if len(data) > USER_DATA_MAX_BYTES:
        raise LocalError(
            f"the machine's files come to {len(data)} bytes of user data, EC2 takes {USER_DATA_MAX_BYTES}: "
            "put what is large (models, meshes, code) into a package named in `requirements`, and keep of a "
            "requirements file the hashes for the machines' platform only"
        )
    return data


def shell_script(files: Mapping[str, bytes], setup: Setup) -> str:
    """Return a bash script with the effect of ``cloud_config``, for root or a user with ``sudo``."""
    packages = shlex.join([*_PACKAGES, *setup.packages])
    lines = [
        "set -euo pipefail",
        "base64 -d <<'EOF' | sudo tar --extract --gzip --no-same-owner --directory / --file -",
        f"{_tar(files, setup)}EOF",
        *(f"sudo {shlex.join(line)}" for line in _CLOSE),
        "sudo apt-get update -qq",
        f"sudo env DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-install-recommends {packages}",
        *(f"sudo {line}" for line in _start(files)),
    ]
    return "\n".join(lines) + "\n"


def lines_of(journal: Iterable[str], program: str, lines: int) -> str:
    """Return the last lines that a program wrote; of ``fog-machine`` itself if no program is named."""
    sign = f"{program or 'fog-machine'}["
    return "\n".join(deque((line.rstrip() for line in journal if sign in line), maxlen=lines))


def _tar(files: Mapping[str, bytes], setup: Setup) -> str:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        for file in placed(files, setup):
            entry = tarfile.TarInfo(file.path.lstrip("/"))
            entry.size, entry.mode = len(file.content), file.mode
            archive.addfile(entry, io.BytesIO(file.content))
    return base64.encodebytes(packed.getvalue()).decode()


def _start(files: Mapping[str, bytes]) -> list[str]:
    programs = read_programs(files[BOOT_FILE]) if BOOT_FILE in files else ()
    units = ["fog-machine"] + [f"fog-log@{each.name}" for each in programs]
    return ["systemctl daemon-reload", f"systemctl enable --now --no-block {' '.join(units)}"]


def _install(setup: Setup, *, fetches: bool) -> str:
    # the service runs it before each start, so an unreachable index is tried again
    head = f"#!/bin/sh\nset -eu\n{_SCRUB}\n{_MAKE_USER}\n{_METADATA}"
    if not setup.has_requirements and not fetches:
        return f"""{head}[ -x {_INSTALLED}/bin/fog-machine ] && exit 0
echo 'nothing is installed: name it in software.wheels, or pinned by hash in requirements of setup' >&2
exit 1
"""
    steps = []
    if fetches:
        steps.append(f"python3 {_FETCH} {HOME}/{SOFTWARE_FILE} {_SOFTWARE}")
    steps.append(f"python3 -m venv {_INSTALLED}")
    pip = f"{_INSTALLED}/bin/pip install --no-input --quiet --require-hashes"
    if fetches:
        offline = "--no-index --no-deps --no-compile --no-cache-dir"
        steps.append(f"{pip} {offline} --requirement {_SOFTWARE}/requirements.txt")
        steps.append(f"mkdir -p {_WORKSPACE}")
        unpack = f'tar --extract --gzip --no-same-owner --file "$each" --directory {_WORKSPACE}'
        steps.append(f'for each in {_SOFTWARE}/{WORKSPACE}/*.tar.gz; do\n[ ! -e "$each" ] || {unpack}\ndone')
    if setup.has_requirements:
        steps.append(f"{pip} --requirement {_REQUIREMENTS}")
    return (
        f"{head}[ -e {_INSTALLED}/complete ] && exit 0\n" + "\n".join([*steps, f"touch {_INSTALLED}/complete"]) + "\n"
    )


def _apt(source: AptSource, key: str) -> bytes:
    parts = " ".join(source.components)
    return f"Types: deb\nURIs: {source.uri}\nSuites: {source.suite}\nComponents: {parts}\nSigned-By: {key}\n".encode()


def _key(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            key = read_at_most(file, _KEY_MAX_BYTES)
    except OSError as error:
        raise LocalError(f"{path}: {error.strerror}") from error
    if not key.startswith(b"-----BEGIN PGP PUBLIC KEY BLOCK-----"):
        raise LocalError(f"{path}: an OpenPGP public key in ASCII armour is expected")
    return key


def _requirements(setup: Setup) -> bytes:
    own = b"" if setup.requirements_file is None else read_requirements(setup.requirements_file).rstrip() + b"\n"
    return own + "".join(f"{each}\n" for each in setup.requirements).encode()


def _service(setup: Setup) -> str:
    return f"""[Unit]
Description=The programs of a machine of a fog cluster
After=network-online.target
Wants=network-online.target
StartLimitIntervalSec=0
SuccessAction=poweroff

[Service]
ExecStartPre=+{_INSTALL}
ExecStart={_start_line(setup)}
Environment={NODE_USER}={_NODE_USER} FASTDDS_BUILTIN_TRANSPORTS=UDPv4
Environment=XDG_RUNTIME_DIR=%t/fog HOME={HOME} ROS_HOME={HOME}/ros
TimeoutStartSec=20min
Restart=on-failure
RestartSec=5
KillMode=mixed
SyslogIdentifier=fog-machine
StandardOutput=journal+console
StandardError=journal+console
{_FENCES}
[Install]
WantedBy=multi-user.target
"""


def _start_line(setup: Setup) -> str:
    scripts = [*setup.source, f"{_WORKSPACE}/local_setup.bash"]
    source = "for each; do if [ -e $$each ]; then . $$each; fi; done"
    return f"/bin/bash -c '{source}; exec {_INSTALLED}/bin/fog-machine --home {HOME}' fog-machine {' '.join(scripts)}"
