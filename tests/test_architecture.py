import ast
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from teamslam.sim.cli.main import load_all
from tests.support import ROOT

PAGES = sorted(
    [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")],
    key=lambda page: page.name,
)
DECISIONS = sorted((ROOT / "docs" / "decisions").glob("[0-9]*.md"))
NOTES = sorted((ROOT / "docs" / "notes").glob("*.md"))
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text()
FOLDERS = ("teamslam", "team", "central", "sim", "tests", "docs", "examples", "benchmarks")
NAMED = re.compile(rf"`((?:{'|'.join(FOLDERS)})/[\w./-]+\.\w+):\s+([^`]+)`")
PATHS = re.compile(rf"`((?:{'|'.join(FOLDERS)})/[\w.-]+(?:/[\w.-]+)*(?:\.\w+|/))[`:]")
"""Folders end with a slash, since keys of the wire look alike."""


@cache
def names_of(path: Path) -> frozenset[str]:
    """Names and `Class.member`s that a module defines; headings of a page."""
    text = path.read_text()
    if path.suffix == ".md":
        return frozenset(re.findall(r"^#+ (.+)$", text, re.MULTILINE))
    found = set()
    for node in ast.parse(text).body:
        for name in _defined(node):
            found.add(name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{name}" for each in node.body for name in _defined(each)}
    return frozenset(found)


def _defined(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return [node.name]
    if isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        return [each.id for each in targets if isinstance(each, ast.Name)]
    return []


def wrong(text: str) -> list[str]:
    found = [
        f"{path}: {name}"
        for path, name in NAMED.findall(text)
        if not (ROOT / path).is_file() or " ".join(name.split()) not in names_of(ROOT / path)
    ]
    return found + [path for path in PATHS.findall(text) if not (ROOT / path).exists()]


@pytest.mark.parametrize("page", PAGES + DECISIONS + NOTES, ids=lambda page: page.name)
def test_every_file_and_name_that_a_page_names_is_there(page):
    assert wrong(page.read_text()) == []


LINK = re.compile(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]+))?\)")


def dangling(page: Path) -> list[str]:
    found = []
    for target, anchor in LINK.findall(page.read_text()):
        file = page.parent / target if target else page
        if not file.is_relative_to(ROOT / "docs" / "generated") and (
            not file.exists() or (anchor and anchor not in anchors(file))
        ):
            found.append(f"{target}#{anchor}" if anchor else target)
    return found


def anchors(page: Path) -> set[str]:
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in names_of(page))
    return {each.strip().replace(" ", "-") for each in plain}


@pytest.mark.parametrize("page", PAGES + DECISIONS + NOTES, ids=lambda page: page.name)
def test_every_link_of_a_page_leads_somewhere(page):
    assert dangling(page) == []


def test_what_is_not_there_is_found(tmp_path):
    (tmp_path / "page.md").write_text("# A heading\n[a](#a-heading) [b](#none) [c](gone.md)\n")
    assert dangling(tmp_path / "page.md") == ["#none", "gone.md"]
    assert wrong("see `team/shell.py: Shell.run` and `team/nothing.py`") == ["team/nothing.py"]
    assert wrong("`team/shell.py: Shell.walk`") == ["team/shell.py: Shell.walk"]
    assert wrong("`docs/wire.md: Keys`, `team/wire/`") == []


def test_the_laws_are_named_with_what_enforces_and_what_proves_them():
    rows = re.findall(r"^\| \*\*(\d)\. .+$", ARCHITECTURE, re.MULTILINE)
    assert rows == ["1", "2", "3", "4"]
    table = ARCHITECTURE[ARCHITECTURE.index("## The four laws") :]
    table = table[: table.index("## Frames")]
    laws = re.findall(r"^\| \*\*.+$", table, re.MULTILINE)
    for law in laws:
        files = {path for path, _ in NAMED.findall(law)}
        assert any(path.startswith("tests/") for path in files)
        assert any(not path.startswith("tests/") for path in files)


COMMAND = re.compile(r"^\s*(?:\$ )?teamslam ([a-z][^\n#]*)", re.MULTILINE)
SPOKEN = re.compile(r"`teamslam ([a-z][^`]*)`")
CLI = load_all()


def unknown(line: str) -> str | None:
    """Unknown commands or options of a command line.

    `...` stands for any command of a group, or for arguments.
    """
    commands: list[Any] = [CLI]
    words = line.split()
    while words and not words[0].startswith("-") and hasattr(commands[0], "commands"):
        word, group = words.pop(0), commands[0].commands
        if word not in {*group, "…"}:
            return f"no command {word!r} in: teamslam {line}"
        commands = [*group.values()] if word == "…" else [group[word]]
    options = {
        name for command in commands for each in command.params
        for name in (*each.opts, *each.secondary_opts)
    }  # fmt: skip
    extra = sorted(
        set(re.findall(r"(?<!\S)--?[a-z][\w-]*", " ".join(words))) - {*options, "--help"}
    )
    return f"no option {extra[0]} in: teamslam {line}" if extra else None


@pytest.mark.parametrize("page", PAGES + DECISIONS + NOTES, ids=lambda page: page.name)
def test_every_command_and_option_that_a_page_names_exists(page):
    text = page.read_text()
    named = [" ".join(each.split()) for each in COMMAND.findall(text) + SPOKEN.findall(text)]
    assert [why for each in named if (why := unknown(each))] == []


def test_a_command_or_an_option_that_is_not_there_is_found():
    assert unknown("launch thesis --seed 2") is None
    assert unknown("log cut LOG --from 60 -o NEW") is None
    assert unknown("experiment … --seeds 3") is None
    assert unknown("experiment … --sedes 3") is not None
    assert unknown("fly me") == "no command 'fly' in: teamslam fly me"
    assert unknown("launch thesis --sed 2") == "no option --sed in: teamslam launch thesis --sed 2"
