#!/usr/bin/env python3
"""Readability figures of the source, printed and compared with committed limits.

    scripts/readability.py                   print the figures
    scripts/readability.py --check           fail if a figure is worse than its limit, or a limit got looser
    scripts/readability.py --save            write the better of limit and figure as limits: they never get looser

``scripts/readability.json`` holds the limits, the goals, the listed words and the exceptions, each with its reason.
Exit status: 0 all limits hold, 1 a figure is worse, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import ast
import gc
import json
import re
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import grimp
import networkx
import yaml
from rich.console import Console
from rich.table import Table

from gdp.crypto.statements import StatementType

ROOT = Path(__file__).resolve().parent.parent
SETTINGS = ROOT / "scripts" / "readability.json"
RAISED = ROOT / "scripts" / "raised_limits.yaml"
CORE = ("gdp", "proxy", "fog")
PRODUCT = (*CORE, "gdp_extensions")
SCANNED = frozenset({".cff", ".in", ".lua", ".md", ".py", ".service", ".sh", ".toml", ".yaml", ".yml"})
HIGHER_IS_BETTER = frozenset({"tests"})

_TOKEN = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_CODE_SPAN = re.compile(r"`[^`]*`")
_LIST_ITEM = re.compile(r"\s*(?:[-*+]|\d+\.)\s+")
_SENTENCE_END = re.compile(r"(?<=[.!?])[\"')*_]*\s+(?=[\"'(*_`\[]*[A-Z0-9`])")
_SECONDS = re.compile(r"_?[A-Z][A-Z0-9_]*_S")
_TEST = re.compile(r"^ *(?:async )?def test_", re.MULTILINE)
_MANY_METHODS, _MANY_ARGUMENTS = 30, 9
_ABBREVIATION = re.compile(r"\b(?:e\.g|i\.e|etc|cf|vs)\.")


class Place(NamedTuple):
    """Position of a finding in a file; line and column count from 1."""

    path: str
    line: int
    column: int
    text: str

    def __str__(self) -> str:
        """Return ``path:line:column: text``."""
        return f"{self.path}:{self.line}:{self.column}: {self.text}"


class Settings(NamedTuple):
    """Content of readability.json.

    Attributes:
        words: every form of a listed word, lower case.
        allowed: patterns of text in which a listed word may stand.
        protocol_names: method names that an interface prescribes.
        limits: worst accepted value of each figure.
        goals: value to reach for each figure.
    """

    words: frozenset[str]
    allowed: tuple[re.Pattern[str], ...]
    protocol_names: frozenset[str]
    limits: dict[str, float]
    goals: dict[str, float]

    @classmethod
    def from_file(cls, path: Path) -> Settings:
        """Read the settings.

        Raises ``OSError``: the file cannot be read. Raises ``ValueError``: it is not the expected JSON.
        """
        data = json.loads(path.read_text())
        try:
            return cls(
                frozenset(form for forms in data["words"].values() for form in forms),
                tuple(re.compile(each["pattern"]) for each in data["allowed"]),
                frozenset(data["protocol_names"]),
                data["limits"],
                data["goals"],
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: wrong or missing key: {error}") from error


def tracked_files(root: Path) -> list[Path]:
    """Return the files that git tracks or would track, in order."""
    command = ["git", "-C", str(root), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return [path for name in sorted(set(listed.split("\0"))) if name and (path := root / name).is_file()]


def _blank(match: re.Match[str]) -> str:
    return " " * len(match[0])


def words_in(text: str, path: str, settings: Settings) -> Iterator[Place]:
    """Yield each listed word of a text; identifiers are split at underscores and capitals.

    Text of the changelog inside backticks quotes old names and is skipped.
    """
    if path == "CHANGELOG.md":
        text = _CODE_SPAN.sub(_blank, text)
    lower = text.lower()
    if not any(word in lower for word in settings.words):
        return
    for number, line in enumerate(text.splitlines(), 1):
        shown = line
        for pattern in settings.allowed:
            shown = pattern.sub(_blank, shown)
        for match in _TOKEN.finditer(shown):
            if match[0].lower() in settings.words:
                yield Place(path, number, match.start() + 1, match[0])


def listed_words(root: Path, files: Iterable[Path], settings: Settings) -> list[Place]:
    """Return each listed word in the names and the content of source and documentation files."""
    found: list[Place] = []
    for file in files:
        name = file.relative_to(root).as_posix()
        if file.suffix not in SCANNED or name.startswith("tests/corpus/"):
            continue
        found += [Place(name, 0, 0, f"file name: {each.text}") for each in words_in(name, "", settings)]
        found += words_in(file.read_text(encoding="utf-8", errors="replace"), name, settings)
    return found


def sentences(markdown: str) -> list[str]:
    """Return the sentences of running text and lists; headings, tables, code blocks and images are left out."""
    blocks: list[list[str]] = [[]]
    fence = ""
    for line in markdown.splitlines():
        bare = line.strip()
        if bare.startswith(("```", "~~~")):
            fence = "" if fence and bare.startswith(fence) else fence or bare[:3]
            blocks.append([])
        elif fence or not bare or bare.startswith(("#", "|", "<", "![")) or re.fullmatch(r"[-=*_ ]+", bare):
            blocks.append([])
        elif item := _LIST_ITEM.match(line):
            blocks.append([line[item.end() :].strip()])
        else:
            blocks[-1].append(bare)
    found: list[str] = []
    for block in blocks:
        text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(block))
        text = _ABBREVIATION.sub(lambda match: match[0].replace(".", ""), _CODE_SPAN.sub("Code", text))
        found += [each for each in _SENTENCE_END.split(text) if word_count(each)]
    return found


def word_count(sentence: str) -> int:
    """Return the number of words, separated by blanks; signs alone do not count."""
    return sum(any(sign.isalnum() for sign in word) for word in sentence.split())


def _pages(root: Path) -> list[Path]:
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def _is_measured(page: Path) -> bool:
    return page.parent.name == "experiments" and page.name != "README.md"  # written by an experiment


def sentence_lengths(root: Path) -> list[int]:
    """Return the words of each sentence of README.md and docs, longest first."""
    return sorted((word_count(each) for page in _pages(root) for each in sentences(page.read_text())), reverse=True)


Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def _decorators(node: Definition) -> set[str]:
    return {ast.unparse(each).rpartition(".")[2] for each in node.decorator_list}


def public_definitions(tree: ast.Module) -> Iterator[tuple[str, Definition]]:
    """Yield public classes and functions of a module, and public methods of its public classes."""
    for node in tree.body:
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)) or node.name.startswith("_"):
            continue
        yield node.name, node
        if isinstance(node, ast.ClassDef):
            for method in node.body:
                if isinstance(method, _FUNCTIONS) and not method.name.startswith("_"):
                    yield f"{node.name}.{method.name}", method


def shared_names(trees: dict[str, ast.Module], excepted: frozenset[str]) -> list[tuple[int, str]]:
    """Return public method names with the number of product packages that define them, most first.

    The sans-I/O part of a package (``core``, ``protocol``) counts as that package.
    """
    packages: dict[str, set[str]] = defaultdict(set)
    for path, tree in trees.items():
        for name, node in public_definitions(tree):
            method = name.rpartition(".")[2]
            is_noun = bool(_decorators(node) & {"property", "cached_property", "setter"})
            if "." in name and not is_noun and method not in excepted:
                packages[method].add(path.rpartition("/")[0].removesuffix("/core").removesuffix("/protocol"))
    return sorted(((len(places), name) for name, places in packages.items()), reverse=True)


def import_circles() -> list[list[str]]:
    """Return the groups of product modules that import each other, those imported late included."""
    graph = grimp.build_graph(*PRODUCT, cache_dir=None)
    arrows: networkx.DiGraph[str] = networkx.DiGraph()
    for module in graph.modules:
        arrows.add_edges_from((module, other) for other in graph.find_modules_directly_imported_by(module))
    return [sorted(group) for group in networkx.strongly_connected_components(arrows) if len(group) > 1]


def line_counts(files: Iterable[Path], root: Path) -> tuple[int, int, int]:
    """Return the lines of the product, of its core, and those of scripts and of the test beds of ``netns_tests``."""
    lines = Counter[str]()
    for file in files:
        folder = file.relative_to(root).parts[0]
        if file.suffix in (".py", ".sh", ".lua") and not (folder == "netns_tests" and file.name.startswith("test_")):
            lines[folder] += len(file.read_text().splitlines())
    core = sum(lines[each] for each in CORE)
    return core + lines["gdp_extensions"], core, lines["scripts"] + lines["netns_tests"]


def shape_counts(trees: Iterable[ast.Module]) -> dict[str, float]:
    """Return the number of constants in seconds, of classes with many methods, of constructors with many arguments."""
    seconds = classes = constructors = 0
    for node in (node for tree in trees for node in ast.walk(tree)):
        if isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            seconds += sum(isinstance(each, ast.Name) and bool(_SECONDS.fullmatch(each.id)) for each in targets)
        elif isinstance(node, ast.ClassDef):
            methods = [each for each in node.body if isinstance(each, _FUNCTIONS)]
            classes += len(methods) >= _MANY_METHODS
            made = [each.args for each in methods if each.name == "__init__"]
            counts = (len([*each.posonlyargs, *each.args, *each.kwonlyargs]) - 1 for each in made)
            constructors += sum(count >= _MANY_ARGUMENTS for count in counts)
    large, long = f"classes of {_MANY_METHODS} methods", f"constructors of {_MANY_ARGUMENTS} arguments"
    return {"constants in seconds": seconds, large: classes, long: constructors}


def _test_count(files: Iterable[Path], root: Path) -> int:
    folders = [root / "tests", root / "netns_tests"]
    chosen = (file for file in files if file.suffix == ".py" and any(each in file.parents for each in folders))
    return sum(len(_TEST.findall(file.read_text())) for file in chosen)


class Report(NamedTuple):
    """Figures by name, and the findings behind them."""

    figures: dict[str, float]
    words: list[Place]
    circles: list[list[str]]


def measure(root: Path, settings: Settings) -> Report:
    """Measure every figure of the source at ``root``; takes some seconds."""
    gc.disable()  # syntax trees are many objects and no garbage
    files = tracked_files(root)
    trees = {
        file.relative_to(root).as_posix(): ast.parse(file.read_text())
        for file in files
        if file.suffix == ".py" and file.relative_to(root).parts[0] in PRODUCT
    }
    words = listed_words(root, files, settings)
    lengths = sentence_lengths(root)
    longest = lengths[: max(1, len(lengths) // 10)]
    names, circles = shared_names(trees, settings.protocol_names), import_circles()
    product, core, beds = line_counts(files, root)
    figures: dict[str, float] = {
        "listed words": len(words),
        "words a sentence": round(sum(lengths) / max(1, len(lengths)), 1),
        "words a sentence, longest tenth": round(sum(longest) / max(1, len(longest)), 1),
        "import circles": len(circles),
        "packages that define one method name": names[0][0] if names else 0,
        "product lines": product,
        "core lines": core,
        "lines of scripts and test beds": beds,
        **shape_counts(trees.values()),
        "signed statement types": len(StatementType),
        "words of docs": sum(len(page.read_text().split()) for page in _pages(root) if not _is_measured(page)),
        "tests": _test_count(files, root),
    }
    return Report(figures, words, circles)


def is_worse(figure: str, value: float, limit: float) -> bool:
    """Return whether ``value`` breaks ``limit``."""
    return value < limit if figure in HIGHER_IS_BETTER else value > limit


def regressions(figures: dict[str, float], limits: dict[str, float]) -> list[str]:
    """Return one line for each figure that is worse than its limit or has none."""
    found: list[str] = []
    for figure, value in figures.items():
        if figure not in limits:
            found.append(f"{figure}: no limit in {SETTINGS.name} (run scripts/readability.py --save)")
        elif is_worse(figure, value, limits[figure]):
            found.append(f"{figure}: {value:g}, limit {limits[figure]:g}")
    return found


def save_limits(path: Path, figures: dict[str, float]) -> None:
    """Write the better of the old limit and the figure as limit; every other key of the file stays."""
    data: dict[str, Any] = json.loads(path.read_text())
    old = data["limits"]
    data["limits"] = {
        figure: old[figure] if figure in old and is_worse(figure, value, old[figure]) else value
        for figure, value in figures.items()
    }
    path.write_text(json.dumps(data, indent=2) + "\n")


def limit_versions(root: Path) -> list[dict[str, float]]:
    """Return the limits as they were committed since ``RAISED`` exists, and those of the working tree, oldest first.

    Outside of a repository, and before the first commit of that file, these are the working tree's only.
    """

    def git(*words: str) -> str:
        asked = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=False)
        return asked.stdout.strip() if asked.returncode == 0 else ""

    settings, raised = (each.relative_to(ROOT).as_posix() for each in (SETTINGS, RAISED))
    begun = git("log", "--diff-filter=A", "--format=%H", "--", raised).split()[-1:]
    order = ("--first-parent", "--reverse", "--format=%H")  # not those of a branch that was merged
    commits = [*begun, *git("log", *order, f"{begun[0]}..HEAD", "--", settings).split()] if begun else []
    texts = [*(git("show", f"{commit}:{settings}") for commit in commits), (root / settings).read_text()]
    return [json.loads(text)["limits"] for text in texts]


def loosened(versions: Sequence[dict[str, float]], reasons: Iterable[dict[str, Any]]) -> list[str]:
    """Return one line for each limit that became looser from a version to the next, and has no reason.

    ``reasons``: for each one that may: ``figure``, the new ``limit``, and ``reason``.
    """
    permitted = {(each["figure"], each["limit"]) for each in reasons if each["reason"]}
    return [
        f"{figure}: the limit was raised from {before[figure]:g} to {limit:g} without a reason in {RAISED.name}"
        for before, after in pairwise(versions)
        for figure, limit in after.items()
        if figure in before and is_worse(figure, limit, before[figure]) and (figure, limit) not in permitted
    ]


def _table(report: Report, settings: Settings) -> Table:
    table = Table("figure", "goal", title="readability", title_justify="left")
    table.add_column("now", justify="right")
    table.add_column("limit", justify="right")
    for figure, value in report.figures.items():
        limit, goal = settings.limits.get(figure), settings.goals.get(figure)
        style = "red" if limit is None or is_worse(figure, value, limit) else ""
        shown = "" if goal is None else f"{'>=' if figure in HIGHER_IS_BETTER else '<='} {goal:g}"
        table.add_row(figure, shown, f"{value:g}", "" if limit is None else f"{limit:g}", style=style)
    return table


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    head, _, text = (__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(
        description=head, epilog=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="fail if a figure is worse than its limit")
    parser.add_argument("--save", action="store_true", help="lower the limits to the present figures")
    options = parser.parse_args(argv)
    console = Console(highlight=False, soft_wrap=True)
    try:
        settings = Settings.from_file(SETTINGS)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    report = measure(ROOT, settings)
    console.print(_table(report, settings))
    for circle in report.circles:
        console.print("import circle:", ", ".join(circle), markup=False)
    for place in report.words:
        console.print(str(place), markup=False)
    if options.save:
        save_limits(SETTINGS, report.figures)
    elif options.check:
        worse = regressions(report.figures, settings.limits)
        worse += loosened(limit_versions(ROOT), yaml.safe_load(RAISED.read_text()))
        for line in worse:
            print(f"readability: worse: {line}", file=sys.stderr)
        return 1 if worse else 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
