"""The documentation site: `make docs` builds it without the network, and every warning is an error.

The pages are Markdown; the command reference comes from the commands themselves, the API reference
from the docstrings, which are plain sentences with formulas and not reStructuredText.
"""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, get_origin

os.environ["NUMBA_DISABLE_JIT"] = "1"  # a kernel is then the function that is written there
HERE = Path(__file__).parent
LEFT_OUT = ("sim/studies", "team/library.py")
"""Of the API reference: programs that make the sources' tables; what has a page of its own."""
GENERATED = HERE / "generated"
sys.path.insert(0, str(HERE.parent))

project = "teamslam"
author = "The teamslam developers"
copyright = f"{author}, Apache-2.0"  # noqa: A001 - Sphinx calls it so
extensions = [
    "myst_parser",
    "sphinx.ext.apidoc",
    "sphinx.ext.autodoc",
    "sphinxcontrib.svgbob",
]
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = "teamslam"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_show_sphinx = False
html_copy_source = False

myst_enable_extensions = ["colon_fence", "dollarmath", "fieldlist"]
myst_heading_anchors = 3
myst_links_external_new_tab = False

apidoc_modules = [
    {
        "path": HERE.parent / package,
        "destination": f"generated/api/{package}",
        "separate_modules": False,
        "module_first": True,
        "max_depth": 1,
        "automodule_options": {"members"},
        "exclude_patterns": [str(HERE.parent / left_out) for left_out in LEFT_OUT],
    }
    for package in ("team", "central", "sim")
]
suppress_warnings = ["ref.python"]  # a type's short name may be that of two classes
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
default_role = "code"
python_maximum_signature_line_length = 88


def _paragraphs(lines: list[str]) -> Iterator[list[str]]:
    """The paragraphs of a docstring, without the empty lines between them."""
    paragraph: list[str] = []
    for line in [*lines, ""]:
        if line.strip():
            paragraph.append(line.strip())
        elif paragraph:
            yield paragraph
            paragraph = []


def _escaped(text: str) -> str:
    """Plain text as reStructuredText: what stands in `backticks` is code, all else is itself."""
    parts = re.split(r"`+([^`]+)`+", text)
    parts[::2] = [re.sub(r"([\\*|_`<>])", r"\\\1", part) for part in parts[::2]]
    parts[1::2] = [f"\\ ``{part}``\\ " for part in parts[1::2]]
    return "".join(parts)


_FIELD = re.compile(r"(?P<names>[a-zA-Z_]\w*(?:, [a-zA-Z_]\w*)*): +(?P<text>\S.*)")


def _as_restructured_text(
    app: object, what: str, name: str, value: object, options: object, lines: list[str]
) -> None:
    """A docstring's lines, in place: `field: meaning` becomes an entry of a list."""
    written: list[str] = []
    for paragraph in _paragraphs(lines):
        for line in paragraph:
            field = _FIELD.fullmatch(line)
            if field is not None:
                names = ", ".join(f"``{each}``" for each in field["names"].split(", "))
                written += ["", f"- {names}: {_escaped(field['text'])}"]
            elif written and written[-1].startswith(("- ", "  ")):
                written.append(f"  {_escaped(line)}")
            else:
                written.append(_escaped(line).lstrip("- "))
        written.append("")
    lines[:] = written


def _is_annotated(
    app: object, what: str, name: str, value: object, skip: bool, options: object
) -> bool | None:
    """Whether a member is left out: a type with a constraint says no more than its definition."""
    return True if get_origin(value) is Annotated else None


def _inline(self: object, node: object) -> None:
    """An equation within a line, as MathML."""
    _write(self, node, "inline")


def _block(self: object, node: object) -> None:
    """An equation of its own, as MathML."""
    _write(self, node, "block")


def _write(writer: object, node: object, display: str) -> None:
    from docutils.nodes import SkipNode
    from latex2mathml.converter import convert

    writer.body.append(convert(node.astext(), display=display))  # type: ignore[attr-defined]
    raise SkipNode


def _write_commands(app: object) -> None:
    """The page of every command with its options, by Typer's own program for it."""
    GENERATED.mkdir(exist_ok=True)
    page = GENERATED / "commands.md"
    command = [sys.executable, "-m", "typer", "sim.cli.main", "utils", "docs", "--name", "teamslam"]
    subprocess.run(  # noqa: S603 - our own command line, no shell
        [*command, "--title", "Commands", "--output", str(page)], check=True, cwd=HERE.parent
    )


def setup(app: object) -> None:
    """Called by Sphinx."""
    app.connect("builder-inited", _write_commands, priority=100)  # type: ignore[attr-defined]
    app.connect("autodoc-skip-member", _is_annotated)  # type: ignore[attr-defined]
    app.connect("autodoc-process-docstring", _as_restructured_text)  # type: ignore[attr-defined]
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))  # type: ignore[attr-defined]
