"""Configuration of the documentation site; `make docs` builds it offline, warnings are errors.

The pages are Markdown. The command reference is generated from the commands, the API reference from
the docstrings of the modules that docs/api.md names; these are plain text with formulas and not
reStructuredText.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, get_origin

HERE = Path(__file__).parent
GENERATED = HERE / "generated"
sys.path.insert(0, str(HERE.parent))

project = "teamslam"
author = "The teamslam developers"
copyright = f"{author}, Apache-2.0"  # noqa: A001 - Sphinx calls it so
extensions = [
    "myst_parser",
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

autodoc_default_options = {"members": True}
suppress_warnings = ["ref.python"]  # a type's short name may be that of two classes
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
default_role = "code"
python_maximum_signature_line_length = 88


def _paragraphs(lines: list[str]) -> Iterator[list[str]]:
    """Yield the paragraphs of a docstring."""
    paragraph: list[str] = []
    for line in [*lines, ""]:
        if line.strip():
            paragraph.append(line.strip())
        elif paragraph:
            yield paragraph
            paragraph = []


def _escaped(text: str) -> str:
    """Convert plain text to reStructuredText; `backticks` enclose code."""
    parts = re.split(r"`+([^`]+)`+", text)
    parts[::2] = [re.sub(r"([\\*|_`<>])", r"\\\1", part) for part in parts[::2]]
    parts[1::2] = [f"\\ ``{part}``\\ " for part in parts[1::2]]
    return "".join(parts)


_FIELD = re.compile(r"(?P<names>[a-zA-Z_]\w*(?:, [a-zA-Z_]\w*)*): +(?P<text>\S.*)")


def _as_restructured_text(
    app: object, what: str, name: str, value: object, options: object, lines: list[str]
) -> None:
    """Convert the lines of a docstring in place; `field: meaning` becomes a list item."""
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
    """Skip types with a constraint, whose documentation is their definition."""
    return True if get_origin(value) is Annotated else None


def _inline(self: object, node: object) -> None:
    """Write an inline equation as MathML."""
    _write(self, node, "inline")


def _block(self: object, node: object) -> None:
    """Write a displayed equation as MathML."""
    _write(self, node, "block")


def _write(writer: object, node: object, display: str) -> None:
    from docutils.nodes import SkipNode
    from latex2mathml.converter import convert

    writer.body.append(convert(node.astext(), display=display))  # type: ignore[attr-defined]
    raise SkipNode


def _write_commands(app: object) -> None:
    """Write the page of all commands with their options."""
    import click

    from teamslam.sim.cli.main import load_all

    lines = ["# Commands"]

    def add_help(command: click.Command, context: click.Context) -> None:
        lines.append(f"\n## `{context.command_path}`\n\n```text\n{command.get_help(context)}\n```")
        for name, inner in getattr(command, "commands", {}).items():
            add_help(inner, click.Context(inner, context, name))

    team = load_all()
    add_help(team, click.Context(team, info_name="teamslam", terminal_width=100))
    GENERATED.mkdir(exist_ok=True)
    (GENERATED / "commands.md").write_text("\n".join(lines) + "\n", "utf-8")


def setup(app: object) -> None:
    """Connect the functions of this module to Sphinx."""
    app.connect("builder-inited", _write_commands, priority=100)  # type: ignore[attr-defined]
    app.connect("autodoc-skip-member", _is_annotated)  # type: ignore[attr-defined]
    app.connect("autodoc-process-docstring", _as_restructured_text)  # type: ignore[attr-defined]
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))  # type: ignore[attr-defined]
