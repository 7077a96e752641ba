"""Manual pages of all commands, made from their help: one for each command and for each group of commands.

python scripts/man_pages.py build/man

The pages are roff with the macros of man(7). They hold no date unless ``SOURCE_DATE_EPOCH`` states one, so the same
sources give the same bytes.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Iterator, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Final

import typer.main
from typer.core import TyperGroup

import gdp

PROGRAMS: Final = {
    "gdp": "gdp.cli.gdp",
    "gdp-delegate": "proxy.cli.delegate",
    "gdp-proxy": "proxy.cli.proxy",
    "gdp-relay": "gdp.cli.relay",
    "gdp-replay": "proxy.cli.replay",
    "gdp-rib": "gdp.cli.rib",
    "gdp-switch": "gdp.cli.switch",
    "fog": "fog.cli.app",
    "fog-machine": "fog.host.cli",
}
_SECTION: Final = "1"
_MANUAL: Final = "Global Data Plane"
_EXAMPLES: Final = re.compile(r"Examples?:\s*")
_EXIT: Final = (
    ("0", "The command is done."),
    ("1", "It was not possible, or not completely; standard error says why."),
    ("2", "The command line, a file or a right is wrong; standard error says what to change."),
)


def pages() -> Iterator[tuple[str, str]]:
    """Yield the file name and the text of each page."""
    for program, module in PROGRAMS.items():
        command = typer.main.get_command(importlib.import_module(module).app)
        yield from _pages(command, [program], None)


def _pages(command: Any, words: list[str], parent: Any) -> Iterator[tuple[str, str]]:
    context = command.context_class(command, info_name=words[-1], parent=parent)
    yield f"{_title(words)}.{_SECTION}", _page(command, words, context)
    if isinstance(command, TyperGroup):
        for name in command.list_commands(context):
            inner: Any = command.get_command(context, name)
            if inner is not None and not inner.hidden:
                yield from _pages(inner, [*words, name], context)


def _page(command: Any, words: Sequence[str], context: Any) -> str:
    summary, description, examples = _help(command)
    title = _title(words)
    lines = [
        f'.TH {_escaped(title.upper())} {_SECTION} "{_date()}" "gdp {gdp.__version__}" "{_MANUAL}"',
        ".SH NAME",
        f"{_escaped(title)} \\- {_escaped(summary.rstrip('.'))}",
        ".SH SYNOPSIS",
        f".B {_escaped(' '.join(words))}",
        _escaped(" ".join(command.collect_usage_pieces(context))),
    ]
    if description:
        lines += [".SH DESCRIPTION", *_paragraphs(description)]
    arguments = [each for each in command.get_params(context) if each.param_type_name == "argument"]
    options = [each for each in command.get_params(context) if each.param_type_name == "option"]
    for heading, listed in (("ARGUMENTS", arguments), ("OPTIONS", options)):
        records = [record for each in listed if (record := each.get_help_record(context)) is not None]
        if records:
            lines += [f".SH {heading}", *(line for names, text in records for line in _item(names, text))]
    names = [] if not isinstance(command, TyperGroup) else command.list_commands(context)
    inner = [(name, each) for name in names if (each := command.get_command(context, name)) and not each.hidden]
    if inner:
        lines.append(".SH COMMANDS")
        for name, each in inner:
            lines += _item(f"{' '.join(words)} {name}", _help(each)[0])
    if examples:
        lines += [".SH EXAMPLES", ".nf", *map(_escaped, examples), ".fi"]
    lines += [".SH EXIT STATUS", *(line for code, text in _EXIT for line in _item(code, text))]
    also = [_title(words[:-1])] if len(words) > 1 else [each for each in PROGRAMS if each != title]
    also += [_title([*words, name]) for name, _ in inner]
    references = [f".BR {_escaped(each)} ({_SECTION})" for each in also]
    lines += [".SH SEE ALSO", *(f"{each} ," for each in references[:-1]), references[-1]]
    return "\n".join(lines) + "\n"


def _title(words: Sequence[str]) -> str:
    """Return a page's name; the group ``gdp rib`` cannot have that of the program ``gdp-rib``."""
    title = "-".join(words)
    return f"{title}-commands" if len(words) > 1 and title in PROGRAMS else title


def _help(command: Any) -> tuple[str, str, list[str]]:
    """Return the first sentence of a help, the paragraphs after it, and the examples."""
    text = (command.help or "").replace("\b\n", "").strip()
    body, *rest = _EXAMPLES.split(text, maxsplit=1)
    shown = rest[0] if rest else ""
    examples = [line.rstrip() for line in shown.split("\n\n")[0].splitlines() if line.strip()]
    if command.epilog:
        examples += [each.strip() for each in _EXAMPLES.sub("", command.epilog).split("; ")]
    paragraphs = [" ".join(each.split()) for each in body.split("\n\n") if each.strip()]
    if rest:
        paragraphs += [" ".join(each.split()) for each in shown.split("\n\n")[1:] if each.strip()]
    first = paragraphs[0] if paragraphs else ""
    return first.split(". ")[0], "\n\n".join(paragraphs), [each.removeprefix("  ").strip() for each in examples]


def _item(names: str, text: str | None) -> list[str]:
    return [".TP", f".B {_escaped(names)}", _escaped(" ".join((text or "").split())) or "\\&"]


def _paragraphs(text: str) -> list[str]:
    paragraphs = text.split("\n\n")
    lines = [_escaped(paragraphs[0])]
    for each in paragraphs[1:]:
        lines += [".PP", _escaped(each)]
    return lines


def _escaped(text: str) -> str:
    """Return text as roff: no escape, no request and no hyphen of its own."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-").replace("'", "\\(aq").replace("`", "\\(ga")
    escaped = escaped.replace('"', "\\(dq").replace("^", "\\(ha").replace("~", "\\(ti")
    escaped = "".join(each if ord(each) < 128 else f"\\[u{ord(each):04X}]" for each in escaped)
    return f"\\&{escaped}" if escaped.startswith(".") else escaped


def _date() -> str:
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    return datetime.fromtimestamp(int(epoch), timezone.utc).strftime("%Y-%m-%d") if epoch.isdigit() else ""


def main(arguments: Sequence[str]) -> int:
    """Write the pages into the named folder; return the exit code."""
    if len(arguments) != 1 or arguments[0].startswith("-"):
        print("usage: python scripts/man_pages.py FOLDER", file=sys.stderr)
        return 2
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    count = 0
    for name, text in pages():
        (folder / name).write_text(text, encoding="ascii")
        count += 1
    print(f"{count} pages in {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
