"""Words that the field has better ones for do not come back, in names or in prose."""

import ast
import inspect
import re
from collections.abc import Iterator
from functools import cache

from tests.support import ROOT

NAMES = {
    "garbage": "an outlier, or clutter where it is a false detection",
    "epoch": "an incarnation of a stream, or a keyframe",
    "honesty": "consistency",
    "hearsay": "name what is reported, and by whom",
    "teller": "a detector of events",
    "begun": "initial_state",
    "stepped": "filter_step",
    "doubts": "warnings",
    "creeping": "low speed",
}
"""Parts of names that are not used, and what is used instead."""
PROSE = {
    **NAMES,
    "sightings?": "an inter-robot measurement",
    "readings": "measurements",
    "honest": "consistent",
    "vain": "say what failed",
}
"""Words of docstrings and pages that are not used; what stands in backticks is a name."""
KEPT = {
    "begun": "a participle: 'it has begun'",
    "stepped": "a participle",
    "doubts": "a verb",
}
"""Parts of names that may stand in prose."""
VAGUE = {
    "told": "a configuration, an announcement, a report: what it is",
    "said": "a message, an announcement, a text: what it is",
    "kept": "stored, remaining, accepted: which of them",
    "heard": "received",
    "met": "an encounter",
    "held": "buffered, known, delayed: which of them",
    "looked": "searched, observed",
    "wanted": "requested, expected",
    "begun": "initial_state",
    "lean": "compact",
    "parted": "separated",
    "elsewhere": "name the place",
}
"""Participles that do not name a thing, and what is used instead; for identifiers of PRODUCT."""
PRODUCT = ("team/", "central/", "sim/")
ON_THE_WIRE = ("team/wire/messages/", "team/wire/channels.py")
"""Where fields and keys are named as logs have them."""
DRIVERS = ("team/driver/", "team/ros2/", "team/ros2_driver.py")
"""Folders whose identifiers are not examined for such participles yet."""
LIBRARY = "team/library.py"
"""Values of users' programs have the names of those that they stand for."""
FORMER = {"team/former_names.py"}
"""Files that are about former names."""
FOLDERS = ("team", "central", "sim", "examples", "benchmarks")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


@cache
def sources() -> list[tuple[str, ast.Module]]:
    """The program's files by their place in the project, parsed."""
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    named = [(path.relative_to(ROOT).as_posix(), path) for path in paths]
    return [
        (name, ast.parse(path.read_text("utf-8"))) for name, path in named if name not in FORMER
    ]


def names_of(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """The names that a file gives: of classes, functions, arguments, variables and fields."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr


def parts_of(name: str) -> set[str]:
    """The words of an identifier, in lower case."""
    return {part.lower() for part in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)}


def docstrings_of(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Docstrings of modules, classes and functions, and those below a constant or a field."""
    for node in ast.walk(tree):
        value = node.value if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            yield node.lineno, inspect.cleandoc(value.value)


def bad_name(name: str) -> str | None:
    """The first part of a name that is not used."""
    return next((word for word in NAMES if word in parts_of(name)), None)


def bad_words(text: str) -> list[str]:
    """The words of a text that are not used, but for names in backticks, fields and keys."""
    prose = re.sub(r"```.*?```|`[^`]*`|^ {4,}\S.*$", " ", text, flags=re.DOTALL | re.MULTILINE)
    words = "|".join(word for word in PROSE if word not in KEPT)
    return re.findall(rf"(?<![/._])\b(?:{words})\b(?![:/_(]|\.\w)", prose, flags=re.IGNORECASE)


def test_no_name_has_a_word_that_the_field_has_a_better_one_for():
    found = [
        f"{name}:{line}: {each}: {NAMES[word]}"
        for name, tree in sources()
        for line, each in names_of(tree)
        if (word := bad_name(each))
    ]
    assert found == []


def test_an_identifier_names_a_thing_and_no_vague_participle():
    found = [
        f"{name}:{line}: {each}: {VAGUE[word]}"
        for name, tree in sources()
        if name.startswith(PRODUCT) and not name.startswith((*ON_THE_WIRE, *DRIVERS))
        for line, each in names_of(tree)
        for word in sorted(parts_of(each) & VAGUE.keys())
    ]
    assert found == []


def test_a_class_of_team_has_a_name_of_its_own_beside_its_message_and_the_library_face():
    places: dict[str, list[str]] = {}
    for name, tree in sources():
        if name.startswith("team/") and not name.startswith((*ON_THE_WIRE, *DRIVERS, LIBRARY)):
            for node in tree.body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    places.setdefault(node.name, []).append(name)
    assert {each: where for each, where in places.items() if len(where) > 1} == {}


def test_no_docstring_and_no_page_has_such_a_word():
    texts = [
        (f"{name}:{line}", text) for name, tree in sources() for line, text in docstrings_of(tree)
    ]
    pages = [(page.relative_to(ROOT).as_posix(), page.read_text("utf-8")) for page in PAGES]
    assert [(where, bad) for where, text in (*texts, *pages) if (bad := bad_words(text))] == []


def test_the_check_finds_such_words_and_leaves_names_in_backticks():
    assert bad_name("GarbageKind") == bad_name("in_garbage") == "garbage"
    assert bad_name("garbageman") is None
    assert parts_of("_said_of") & VAGUE.keys() == parts_of("SaidBy") & VAGUE.keys() == {"said"}
    assert not parts_of("metres_along") & VAGUE.keys()
    assert bad_words("Three readings, of which one is\ngarbage.") == ["readings", "garbage"]
    assert bad_words("`sightings` on `source/r1/sightings`, sightings: those of this tick") == []
    assert bad_words("it has begun") == []
