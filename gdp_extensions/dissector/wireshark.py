"""Command ``gdp wireshark``: the dissector for Wireshark and tshark."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.output import show
from gdp.cli.program import Program
from gdp.errors import LocalError
from gdp.extras import require_extra
from gdp.intervals import SERVER_S
from gdp.stores.files import public, read_public, write_all

app = Program("gdp wireshark")

_FILE: Final = "gdp.lua"
_DEFAULT_FOLDER: Final = Path("~/.local/lib/wireshark/plugins")  # Wireshark User's Guide, appendix B.4
_FOLDER_LABEL: Final = "Personal Lua Plugins:"

Install = Annotated[bool, typer.Option("--install", help="write it to Wireshark's folder for your own plugins")]


@app.command()
def wireshark(
    install: Install = False,
    out: options.Out = None,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Print a Wireshark dissector for our frames, in Lua, made from the Scapy layers; --install puts it in place.

    An installed dissector of an earlier version is replaced; another file of that name only with --force.

    \b
    Examples:
      gdp wireshark --install
      gdp wireshark > gdp.lua
      tshark -i eth0 -X lua_script:gdp.lua -Y 'gdp.kind == 0x80'
    """
    require_extra("scapy", ("scapy",), "gdp wireshark")
    from gdp_extensions.dissector.dissector import FIRST_LINE, dissector

    text = dissector()
    if install and out is not None:
        raise LocalError("--install and --out both say where the dissector goes: give one of them")
    if not install and out is None:
        if as_json:
            show({"file": _FILE, "text": text}, as_json=True)
        else:
            typer.echo(text, nl=False)
        return
    path = out if out is not None else _plugin_folder() / _FILE
    is_ours = path.exists() and read_public(path).decode("utf-8", "replace").startswith(FIRST_LINE)
    write_all(path.parent, {path.name: public(text.encode())}, force=force or is_ours)
    show({"dissector": str(path), "replaced": is_ours}, as_json=as_json)


def _plugin_folder() -> Path:
    """Return the folder that tshark names, or Wireshark's usual one where there is no tshark."""
    program = shutil.which("tshark")
    if program is not None:
        try:
            result = subprocess.run(
                [program, "-G", "folders"], capture_output=True, text=True, timeout=SERVER_S, check=True
            ).stdout
        except (OSError, subprocess.SubprocessError) as error:
            raise LocalError(f"{program} -G folders fails, so the folder of plugins is unknown: {error}") from error
        for line in result.splitlines():
            if line.startswith(_FOLDER_LABEL):
                return Path(line.removeprefix(_FOLDER_LABEL).strip())
    return _DEFAULT_FOLDER.expanduser()
