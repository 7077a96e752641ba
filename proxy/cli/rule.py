"""``gdp rule``: rules of a proxy, changed by command while it runs.

I/O. Exit codes: 0 done, 2 wrong input or refused; then nothing has changed.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Final, cast

import typer
import yaml

from gdp.cli import options
from gdp.cli.output import show
from gdp.cli.program import Program
from gdp.cli.secret import NAME_SALT
from gdp.config.drop_in import drop_in_directory
from gdp.config.yaml_source import LOADER, Plain, read_yaml
from gdp.errors import LocalError
from gdp.metadata import SALT
from proxy.config.rule_drop_in import RULE_LISTS, ListedRule, RuleDropIn, RuleList

app = Program(
    "gdp rule",
    no_args_is_help=True,
    help="Rules of a proxy, changed while it runs; they are kept in proxy.yaml.d/gdp-rule.yaml.",
)

_PATHS: Final = ("owner", "salt_file")

Side = Annotated[str, typer.Argument(metavar="expose|import|deny", help="The list of proxy.yaml.")]
RuleName = Annotated[str, typer.Argument(metavar="NAME", help="A ROS name, or a pattern: /camera/* or /camera/**.")]
ConfigFile = Annotated[Path, typer.Option("--config", metavar="FILE", help="The configuration of the proxy.")]
RuleKind = Annotated[str, typer.Option("--kind", help="topic, service or action")]
RuleType = Annotated[str, typer.Option("--type", help="Its type, such as sensor_msgs/msg/Image; else as it is found.")]
OwnerKey = Annotated[
    Path | None,
    typer.Option("--owner", metavar="FILE", help="The owner's public key (owner.pub). Default: proxy.yaml's owner."),
]
Settings = Annotated[
    list[str], typer.Option("--set", metavar="KEY=VALUE", help="Another key of the rule; may be repeated.")
]
DEFAULT_CONFIG: Final = Path("proxy.yaml")


@app.command("add", no_args_is_help=True)
def add(
    side: Side,
    name: RuleName,
    kind: RuleKind = "topic",
    type_: RuleType = "",
    owner: OwnerKey = None,
    settings: Settings = [],  # noqa: B006 (the library copies it)
    config: ConfigFile = DEFAULT_CONFIG,
    as_json: options.Json = False,
) -> None:
    """Add a rule, or a name that never crosses; a running proxy applies it at once.

    \b
    Examples:
      gdp rule add expose '/camera/**' --owner keys/lab.pub
      gdp rule add expose /scan --type sensor_msgs/msg/LaserScan --owner keys/lab.pub --set max_hz=5
      gdp rule add deny '/camera/raw/**'
    """
    rules, listed = RuleDropIn(config), _side(side)
    keys: dict[str, Plain] = {"name": name}
    if listed == "deny":
        if type_ or owner is not None or settings or kind != "topic":
            raise LocalError("rule add deny: it takes a NAME alone; all kinds of that name stay local")
    else:
        owner = owner or _owner_in(config)
        if owner is None:
            raise LocalError(f"rule add {listed}: state the owner's public key with --owner FILE")
        keys = {"kind": kind, **keys, **({"type": type_} if type_ else {}), "owner": str(owner)}
        for text in settings:
            key, value = _setting(text)
            if isinstance(value, dict) and SALT in value:
                raise NAME_SALT.refused(f"--set {key}={{salt: ...}}", "--set salt_file=FILE")
            if key in keys:
                raise LocalError(f"--set {key}: it is stated already")
            keys[key] = value
        folder = drop_in_directory(config.absolute())
        keys |= {key: os.path.relpath(str(keys[key]), folder) for key in _PATHS if key in keys}
    _done("added", listed, name, is_running=rules.add(listed, keys), as_json=as_json)


@app.command("remove", no_args_is_help=True)
def remove(
    side: Side,
    name: RuleName,
    kind: Annotated[str, typer.Option("--kind", help="topic, service or action; default: any")] = "",
    config: ConfigFile = DEFAULT_CONFIG,
    as_json: options.Json = False,
) -> None:
    """Remove a rule that 'gdp rule add' made; a running proxy applies it at once.

    \b
    Examples:
      gdp rule remove expose '/camera/**'
      gdp rule remove deny '/camera/raw/**'
    """
    listed = _side(side)
    _done("removed", listed, name, is_running=RuleDropIn(config).remove(listed, kind, name), as_json=as_json)


@app.command("list")
def list_rules(config: ConfigFile = DEFAULT_CONFIG, as_json: options.Json = False) -> None:
    """Show the rules of proxy.yaml and of all its drop-ins, with their places.

    \b
    Examples:
      gdp rule list
      gdp rule list --config robot/proxy.yaml --json
    """
    rules = RuleDropIn(config).rules()
    fields = [{"list": each.side, "rule": each.keys, "where": each.where, "removable": each.is_own} for each in rules]
    lines = [_line(each) for each in rules]
    show({"rules": fields}, as_json=as_json, plain="\n".join(lines) or "no rules: all names stay local")


def _line(rule: ListedRule) -> str:
    words = [rule.side, *([] if rule.side == "deny" else [str(rule.keys.get("kind", "topic"))])]
    words += [str(rule.keys.get("name")), *([f"[{rule.keys['type']}]"] if rule.keys.get("type") else [])]
    return f"{' '.join(words)}  {rule.where}"


def _owner_in(config: Path) -> Path | None:
    """Return the public key file that ``owner`` of a configuration names for all its rules."""
    data = read_yaml(config).data
    stated = data.get("owner") if isinstance(data, dict) else None
    return config.parent / Path(stated).expanduser() if isinstance(stated, str) else None


def _side(text: str) -> RuleList:
    if text not in RULE_LISTS:
        raise LocalError(f"{text!r}: expected expose, import or deny")
    return text


def _setting(text: str) -> tuple[str, Plain]:
    key, equals, value = text.partition("=")
    if not key or not equals:
        raise LocalError(f"--set {text}: expected KEY=VALUE, such as max_hz=5")
    try:
        return key, cast(Plain, yaml.load(value, Loader=LOADER))
    except yaml.YAMLError as error:
        raise LocalError(f"--set {text}: the value is no YAML") from error


def _done(what: str, side: RuleList, name: str, *, is_running: bool, as_json: bool) -> None:
    applied = "now" if is_running else "at the next start of the proxy"
    fields = {what: name, "list": side, "applied": applied, "is_running": is_running}
    show(fields, as_json=as_json, plain=f"{what} {side} {name}: {applied}")
