"""Commands declared by the signatures of functions: parameters, help in sections, errors."""

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NamedTuple, NoReturn, TypeVar, get_args, get_origin

import click
from click.exceptions import Exit

from teamslam.team.wire.logs import printable_lines

ARGUMENTS = "Arguments"
OPTIONS = "Options"  # section of the options that most users need
NETWORK = "Network and keys"
RARE = "Rarely needed"
LAST: Mapping[str, int] = {RARE: 1, NETWORK: 2}
"""Order of the sections behind the others."""
PLACEHOLDERS: Mapping[object, str] = {str: "TEXT", int: "N", float: "X", Path: "PATH"}
"""Placeholder of an option's value by its type, if the option has none."""
WRONG_USE = 2
FAILED = 1
INTERRUPTED = 130  # exit status after Ctrl-C, by the shell's convention
F = TypeVar("F", bound=Callable[..., None])


class Parameter(NamedTuple):
    """Help and limits of a parameter, beside its type in `Annotated`.

    words: its names, which begin with a dash, and the placeholder of its value.
    """

    help: str
    words: tuple[str, ...]
    section: str
    least: float | None
    most: float | None


def option(
    text: str,
    *words: str,
    section: str = OPTIONS,
    least: float | None = None,
    most: float | None = None,
) -> Parameter:
    """Describe an option."""
    return Parameter(text, words, section, least, most)


argument = partial(option, section=ARGUMENTS)
rare = partial(option, section=RARE)
network = partial(option, section=NETWORK)


def output_option(text: str, *words: str) -> Parameter:
    """Describe the option `--output`, or `-o`."""
    return option(text, "--output", "-o", *words)


class _Plain(click.Command):
    """Help of a command or group in plain sections; its epilog is an example."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        if self.epilog:
            with formatter.section("Example" if "\n" not in self.epilog else "Examples"):
                for line in self.epilog.splitlines():
                    formatter.write(f"{'':{formatter.current_indent}}{line}\n")

    def get_short_help_str(self, limit: int = 0) -> str:
        first = " ".join((self.help or "").split("\n\n")[0].split())
        return first.removesuffix(".")


class Command(_Plain):
    """Command of a function, with the parameters of its signature."""

    def __init__(self, function: Callable[..., None], example: str, name: str, text: str) -> None:
        parameters = inspect.signature(function).parameters
        self._sections = {
            name: get_args(of.annotation)[1].section for name, of in parameters.items()
        }
        made = [_click_parameter(name, of) for name, of in parameters.items()]
        super().__init__(name, callback=function, params=made, help=text, epilog=example)

    def format_arguments(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Leave arguments to the sections."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write arguments, then the sections of options."""
        sections: dict[str, list[tuple[str, str]]] = {ARGUMENTS: [], OPTIONS: []}
        for each in self.get_params(ctx):
            if (record := each.get_help_record(ctx)) is not None:
                title = self._sections.get(each.name, OPTIONS)
                sections.setdefault(title, []).append(record)
        for title in sorted(sections, key=lambda each: LAST.get(each, 0)):
            if sections[title]:
                with formatter.section(title):
                    formatter.write_dl(sections[title], col_max=26)


class Group(click.Group, _Plain):
    """Group of commands, each declared by a function."""

    def declare(self, example: str, name: str = "", text: str = "") -> Callable[[F], F]:
        """Add the command of a function, whose docstring is its help."""

        def register(function: F) -> F:
            called = name or function.__name__
            self.add_command(Command(function, example, called, text or function.__doc__ or ""))
            return function

        return register

    @property
    def by_section(self) -> Mapping[str, Iterable[str]]:
        """Titles of the sections of commands, and their names."""
        return {"Commands": self.commands}

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections of commands, then the options of the group."""
        self.format_commands(ctx, formatter)
        click.Command.format_options(self, ctx, formatter)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write a line per command."""
        found = {name: self.get_command(ctx, name) for name in self.list_commands(ctx)}
        shown = {name: each for name, each in found.items() if each and not each.hidden}
        width = max(map(len, shown), default=0)
        for title, names in self.by_section.items():
            rows = [(n.ljust(width), shown[n].get_short_help_str()) for n in names if n in shown]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


class _Choice(click.Choice[Any]):
    def normalize_choice(self, choice: object, ctx: click.Context | None) -> str:
        return str(choice)


def _click_parameter(name: str, of: inspect.Parameter) -> click.Parameter:
    annotated, described = get_args(of.annotation)
    kind = get_args(annotated)[0] if isinstance(annotated, UnionType) else annotated
    is_list = get_origin(kind) is list
    if is_list:
        (kind,) = get_args(kind)
    names = [each for each in described.words if each.startswith("-")]
    placeholder = next((each for each in described.words if each not in names), None)
    settings: dict[str, Any] = {"help": described.help, "required": True}
    if of.default is not inspect.Parameter.empty:
        is_enum = isinstance(of.default, StrEnum)
        settings |= {"required": False, "default": of.default.value if is_enum else of.default}
    if kind is not bool:
        settings |= {"type": _type_of(kind, described), "metavar": placeholder}
    if described.section == ARGUMENTS:
        return click.Argument([name], nargs=-1 if is_list else 1, **settings)
    flag = name.replace("_", "-")
    if kind is bool:
        names = names or [f"--{flag}/--no-{flag}"]
        settings["is_flag"] = True
    else:
        settings |= {"metavar": placeholder or PLACEHOLDERS.get(kind), "multiple": is_list}
    return click.Option([name, *(names or [f"--{flag}"])], show_default=True, **settings)


def _type_of(kind: Any, described: Parameter) -> Any:
    if get_origin(kind) is Literal:
        return click.Choice(get_args(kind))
    if issubclass(kind, StrEnum):
        return _Choice(kind)
    if kind is Path:
        return click.Path(path_type=Path)
    least, most = described.least, described.most
    if least is None and most is None:
        return kind
    if kind is float:
        return click.FloatRange(least, most)
    low, high = (None if each is None else int(each) for each in (least, most))
    return click.IntRange(low, high)


def fail(message: str, status: int = FAILED) -> NoReturn:
    """Print an error and exit with this status."""
    print_error(message)
    raise Exit(status)


def refuse(message: str) -> NoReturn:
    """Print an error about the use of a command, and exit with 2."""
    fail(message, WRONG_USE)


def print_error(message: str) -> None:
    """Print an error on stderr."""
    click.secho(f"error: {printable_lines(message)}", fg="red", err=True)


@contextmanager
def failing(*errors: type[Exception], at: object = "", status: int = FAILED) -> Iterator[None]:
    """Exit with this status and the text of such an error, after the text of `at`."""
    try:
        yield
    except errors as error:
        fail(f"{at}: {error}" if at else str(error), status)


refusing = partial(failing, status=WRONG_USE)
