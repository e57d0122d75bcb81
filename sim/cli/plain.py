"""Parse the words of a command by its signature.

Typer's parser loads Pydantic: 9 MB and 80 ms of CPU per process. Typer answers all else: help,
mistakes, options with bounds.
"""

import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin

from typer.models import ArgumentInfo


def parse_plainly(function: Callable[..., object], words: Sequence[str]) -> dict[str, Any] | None:
    """Arguments that are words, paths and flags; None: ask Typer."""
    places: list[tuple[str, type]] = []
    options: dict[str, tuple[str, type, bool]] = {}
    found: dict[str, Any] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        annotated, info = get_args(parameter.annotation)
        kinds = get_args(annotated) if isinstance(annotated, UnionType) else (annotated,)
        kind = next(each for each in kinds if each is not NoneType)
        if parameter.default is not inspect.Parameter.empty:
            is_list = get_origin(kind) is list and parameter.default is None
            found[name] = () if is_list else parameter.default
        if isinstance(info, ArgumentInfo):
            places.append((name, kind))
            continue
        flag = name.replace("_", "-")
        own = f"--{flag}/--no-{flag}" if kind is bool else f"--{flag}"
        declared = [each for each in (info.default, *(info.param_decls or ())) if each is not ...]
        for written in declared or [own]:
            for word, value in zip(written.split("/"), (True, False), strict=False):
                options[word.strip()] = (name, kind, value)
    rest = iter(words)
    for word in rest:
        if not word.startswith("-") and places:
            name, kind = places.pop(0)
            text: str | None = word
        elif word in options and options[word][1] is bool:
            name, kind, found[name] = options[word]
            continue
        else:
            option, is_joined, joined = word.partition("=")
            name, kind, _ = options.get(option, ("", NoneType, True))
            text = joined if is_joined and option.startswith("--") else next(rest, None)
        if kind not in (str, Path) or text is None or text.startswith("-"):
            return None
        found[name] = kind(text)
    return None if len(found) < len(inspect.signature(function).parameters) else found
