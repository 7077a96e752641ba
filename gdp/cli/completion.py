"""``gdp completion``: script that lets a shell complete the words of all our commands.

I/O. The script runs the command that is being completed with an environment variable. The command then prints the
possible words and ends; typer does that part.
"""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.output import show

PROGRAMS: Final = (
    "gdp",
    "gdp-delegate",
    "gdp-proxy",
    "gdp-relay",
    "gdp-replay",
    "gdp-rib",
    "gdp-switch",
    "fog",
    "fog-machine",
)
_NODES_MAX: Final = 64  # offered at once
_BASH: Final = """\
# Completion of @PROGRAMS@ for bash 4.4 or later.
_gdp_programs_complete() {
    local program="${1##*/}" line variable
    variable="_${program^^}_COMPLETE"
    COMPREPLY=()
    while IFS= read -r line; do
        [[ -n $line ]] && COMPREPLY+=("$line")
    done < <(env "${variable//-/_}=complete_bash" COMP_WORDS="${COMP_WORDS[*]}" COMP_CWORD="$COMP_CWORD" \\
        "$1" 2>/dev/null)
}
complete -o default -F _gdp_programs_complete @PROGRAMS@
"""
_ZSH: Final = """\
#compdef @PROGRAMS@
# Completion of @PROGRAMS@ for zsh.
_gdp_programs() {
    local program="${words[1]:t}" line
    local -a found
    local variable="_${${(U)program}//-/_}_COMPLETE"
    for line in "${(@f)$(env "$variable=complete_fish" _TYPER_COMPLETE_FISH_ACTION=get-args \\
        _TYPER_COMPLETE_ARGS="${words[1,$CURRENT]}" "${words[1]}" 2>/dev/null)}"; do
        [[ -n $line ]] && found+=("${${line%%$'\\t'*}//:/\\\\:}:${${(M)line%%$'\\t'*}:+}${line#*$'\\t'}")
    done
    if (( $#found )); then
        _describe 'gdp' found
    else
        _files
    fi
}
if [[ $zsh_eval_context[-1] == loadautofunc ]]; then
    _gdp_programs "$@"
else
    compdef _gdp_programs @PROGRAMS@
fi
"""
_FISH: Final = """\
# Completion of @PROGRAMS@ for fish.
function __gdp_programs_complete
    set -l words (commandline -opc)
    set -l program (string upper (string replace -a -- - _ (basename $words[1])))
    set -l found (env _"$program"_COMPLETE=complete_fish _TYPER_COMPLETE_FISH_ACTION=get-args \\
        _TYPER_COMPLETE_ARGS=(commandline -cp) $words[1] 2>/dev/null | string match -v '')
    if test (count $found) -gt 0
        printf '%s\\n' $found
    else
        __fish_complete_path (commandline -ct)
    end
end
for program in @PROGRAMS@
    complete --command $program --no-files --arguments '(__gdp_programs_complete)'
end
"""


class Shell(str, Enum):
    """Shell whose script is printed."""

    BASH = "bash"
    ZSH = "zsh"
    FISH = "fish"


_SCRIPTS: Final = {Shell.BASH: _BASH, Shell.ZSH: _ZSH, Shell.FISH: _FISH}


def completion_script(shell: Shell) -> str:
    """Return the script for a shell."""
    return _SCRIPTS[shell].replace("@PROGRAMS@", " ".join(PROGRAMS))


def completion(shell: Annotated[Shell, typer.Argument(help="Your shell.")], as_json: options.Json = False) -> None:
    """Print a script that completes the commands, options, topics and nodes of gdp, gdp-switch, fog and the others.

    \b
    Examples:
      gdp completion bash > ~/.gdp-completion && echo 'source ~/.gdp-completion' >> ~/.bashrc
      gdp completion zsh > ~/.zfunc/_gdp        (with 'fpath+=~/.zfunc' before 'compinit' in ~/.zshrc)
      gdp completion fish > ~/.config/fish/conf.d/gdp.fish
    """
    script = completion_script(shell)
    if as_json:
        show({"shell": shell.value, "programs": list(PROGRAMS), "script": script}, as_json=True)
    else:
        typer.echo(script, nl=False)


def complete_node(incomplete: str) -> list[str]:
    """Return the directories of nodes that begin with a text, two levels deep."""
    from gdp.stores.keyring import NODE_CERTIFICATE  # it loads what reads keys

    folder, _, begin = incomplete.rpartition("/")
    base = Path(folder or ("/" if incomplete.startswith("/") else "."))
    patterns = (f"{begin}*/{NODE_CERTIFICATE}", f"{begin}*/*/{NODE_CERTIFICATE}")
    found = sorted(path.parent for pattern in patterns for path in base.glob(pattern))
    return [str(path) for path in found[:_NODES_MAX]]
