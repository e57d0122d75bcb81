"""Help texts in plain sections: commands by task, options by use, an example each."""

import re
from collections.abc import Iterable
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from teamslam.sim.scenarios.checks import close

OPTIONS = "Options"
"""Section of the options that most users need."""
NETWORK = "Network and keys"
RARE = "Rarely needed"
SECTIONS = {
    "Run a team": ("launch", "localise", "scenarios", "simulate"),
    "Look at a run": (
        "view", "report", "compare", "rerun", "map", "log", "verify-ledger", "repair",
    ),
    "Use your data": ("import", "calibrate", "batch-reference", "experiment"),
    "Run one process": (
        "router", "record", "central", "robot", "driver", "world", "viewer", "replay",
    ),
    "Operate a running team": ("status", "end", "withdraw", "verdict", "keys"),
}  # fmt: skip
"""Commands of `teamslam` by task, the most frequent first."""
WIDEST = 100
"""Columns of a help text in a wide terminal."""
WIDE = {"max_content_width": WIDEST}


def rare(*names: str, **settings: Any) -> Any:
    """Option in the section of those that are rarely needed."""
    return typer.Option(*names, rich_help_panel=RARE, **settings)


def network(*names: str, **settings: Any) -> Any:
    """Option in the section about network and keys."""
    return typer.Option(*names, rich_help_panel=NETWORK, **settings)


def output_option(text: str, **settings: Any) -> Any:
    """Option `--output`, or `-o`, with this help."""
    return typer.Option("--output", "-o", help=text, **settings)


class _Plain:
    """Help of a command or group in plain sections; its epilog is an example."""

    def parse_args(self: Any, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words; name the closest option for an unknown one."""
        try:
            parsed: list[str] = super().parse_args(ctx, args)  # type: ignore[misc]
        except typer.TyperException as error:
            option = getattr(error, "option_name", None)
            if option is not None and hasattr(error, "possibilities"):
                parameters = self.get_params(ctx)
                known = [name for each in parameters for name in (*each.opts, *each.secondary_opts)]
                error.message = f"No such option: {option}{close(option, known)}"
                error.possibilities = None
            raise
        return parsed

    def collect_usage_pieces(self: Any, ctx: Any) -> list[str]:
        """Words of the usage line, arguments as in their section: `LOG`, `[SCENARIO]`."""
        pieces: list[str] = super().collect_usage_pieces(ctx)  # type: ignore[misc]
        return [piece.upper().replace("{", "").replace("}", "") for piece in pieces]

    def format_options(self: Any, ctx: Any, formatter: Any) -> None:
        """Write arguments, then the sections of options."""
        _write_parameters(self.get_params(ctx), ctx, formatter)

    def format_epilog(self: Any, ctx: Any, formatter: Any) -> None:
        """Write the example."""
        if self.epilog:
            with formatter.section("Example" if "\n" not in self.epilog else "Examples"):
                for line in self.epilog.splitlines():
                    formatter.write(f"{'':{formatter.current_indent}}{line}\n")

    def get_short_help_str(self: Any, limit: int = 0) -> str:
        """First sentence of the help, whole."""
        first = " ".join((self.short_help or self.help or "").split("\n\n")[0].split())
        return first.removesuffix(".")


class Command(_Plain, TyperCommand):
    """Command whose options have sections."""


class Group(_Plain, TyperGroup):
    """Group of commands, in sections if it is `teamslam` itself."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the sections of commands, then the options of the group."""
        self.format_commands(ctx, formatter)
        super().format_options(ctx, formatter)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a line per command."""
        shown = {name: each for name, each in self.commands.items() if not each.hidden}
        width = max(map(len, shown), default=0)
        sections = SECTIONS if "launch" in shown else {"Commands": tuple(shown)}
        for title, names in sections.items():
            found = [(name, shown[name]) for name in names if name in shown]
            rows = [(name.ljust(width), each.get_short_help_str()) for name, each in found]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


def _write_parameters(parameters: Iterable[Any], ctx: Any, formatter: Any) -> None:
    sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], OPTIONS: []}
    for each in parameters:
        record = each.get_help_record(ctx)
        if record is None:
            continue
        if each.param_type_name == "argument":
            name = each.display_name_raw.upper() + ("..." if each.nargs != 1 else "")
            sections["Arguments"].append((name, record[1]))
        else:
            name = _TYPE.sub(_named_type, record[0])
            sections.setdefault(each.rich_help_panel or OPTIONS, []).append((name, record[1]))
    order = [*(name for name in sections if name not in (NETWORK, RARE)), RARE, NETWORK]
    for title in order:
        if rows := sections.get(title):
            with formatter.section(title):
                formatter.write_dl(rows, col_max=26)


_TYPE = re.compile(r"<([^<>]+)>")
_TYPES = {
    "str": "TEXT",
    "int range": "N",
    "float range": "X",
    "float": "X",
    "list[Path]": "PATH",
    "list[str]": "NAME",
}


def _named_type(found: re.Match[str]) -> str:
    """Placeholder for a value: `PATH` for `<path>`, choices as they are."""
    text = found[1]
    return text if "|" in text else _TYPES.get(text, text.upper())
