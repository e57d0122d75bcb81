"""Check scenarios: errors name field path, known values and remedy."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec

from teamslam.team.former_names import GONE

TOP_LEVEL = ("seed", "estimator", "fusion")
"""Robot and centre fields that the scenario has once, at its top."""

_IN_WORDS = {
    "^[a-z][a-z0-9_]{0,31}$": "a small letter, then small letters, digits and _ (32 at most)",
    "^[A-Za-z0-9_.-]{1,64}$": "letters, digits, _, . and - (64 at most)",
}


LARGEST_SIGMA_RAD = 0.5  # bearing standard deviation [rad] above which degrees are probable


class ScenarioError(ValueError):
    """Invalid scenario; the text names file, field and remedy."""


def check_fields(value: object, declared: Any, at: str) -> None:
    """Refuse unknown fields, wrong choices and non-finite numbers of a value of a declared type.

    at: path in the file. msgspec checks types and bounds.
    """
    if get_origin(declared) is Annotated:
        declared = get_args(declared)[0]
    if get_origin(declared) is Literal:
        choices = get_args(declared)
        if value not in choices:
            known = ", ".join(f'"{choice}"' for choice in choices)
            raise ScenarioError(f"expected one of {known}, got {value!r} at {at}")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ScenarioError(f"expected a finite number, got {value} at {at}")
    elif isinstance(value, list | tuple):
        part_type = get_args(declared)[0] if get_origin(declared) is tuple else object
        for i, part in enumerate(value):
            check_fields(part, part_type, f"{at}[{i}]")
    elif isinstance(value, dict) and _is_struct(declared):
        types = types_of(declared)
        tag = declared.__struct_config__.tag_field
        for name, part in value.items():
            if name != tag:
                check_known(name, [known for known in types if _here(known, at)], at)
                if name == "bearing_sigma":
                    _check_radians(part, f"{at}.{name}" if at else name)
                check_fields(part, types[name], f"{at}.{name}" if at else name)


def _check_radians(sigma: object, at: str) -> None:
    if isinstance(sigma, int | float) and LARGEST_SIGMA_RAD < sigma <= math.pi:
        raise ScenarioError(
            f"{sigma:g} rad is {math.degrees(sigma):.0f}°, at {at}; if it is in degrees, "
            f"write {math.radians(sigma):.4g}"
        )


@cache
def types_of(declared: type) -> dict[str, Any]:
    """Field types of a struct, cached since evaluation is slow."""
    return {field.name: field.type for field in msgspec.structs.fields(declared)}


def check_known(name: str, known: list[str], at: str) -> None:
    """Refuse an unknown name."""
    if name in known:
        return
    where = f"at {at}" if at else "at the top"
    hint = close(name, known)
    if name in GONE:
        raise ScenarioError(f"{name} {where} is not a setting any more; {GONE[name]}")
    if name in TOP_LEVEL:
        hint = f"; `{name}` is set once for the whole team, at the top of the file"
    raise ScenarioError(f"unknown field `{name}` {where}; known: {', '.join(known)}{hint}")


def close(name: object, known: Iterable[str]) -> str:
    """Suggestion of the closest known name, or empty."""
    import difflib  # of errors only

    found = difflib.get_close_matches(str(name), list(known), n=1)
    return f"; did you mean `{found[0]}`?" if found else ""


def plain_error(error: msgspec.ValidationError, at: str = "", of: object = None) -> ScenarioError:
    """Convert "Expected `float`, got `str` - at `$.a.b`" to "expected float, got str at a.b".

    of: the converted fields, which give the value: "expected float > 0 at a.b: 0".
    """
    problem, _, path = str(error).partition(" - at `")
    field = path.rstrip("`").removeprefix("$").lstrip(".")
    where = ".".join(part for part in (at, field) if part)
    problem = problem[:1].lower() + problem[1:].replace("`", "")
    problem = problem.replace(f"float <= {math.pi}", "radians, half a turn at most,")
    for pattern, words in _IN_WORDS.items():
        problem = problem.replace(f"str matching regex '{pattern}'", words)
    value = _value_at(path.rstrip("`"), of)
    given = f": {value}" if isinstance(value, int | float) and ", got " not in problem else ""
    return ScenarioError(f"{problem} at {where}{given}" if where else problem)


def _value_at(path: str, of: object) -> object:
    """Value at a path such as `$.robots[0].id`, or None."""
    if "[...]" in path:  # of a key that the path does not state
        return None
    for name, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        if isinstance(of, Mapping):
            of = of.get(name)
        elif isinstance(of, Sequence) and index and int(index) < len(of):
            of = of[int(index)]
        else:
            return None
    return of


def _is_struct(declared: Any) -> bool:
    return isinstance(declared, type) and issubclass(declared, msgspec.Struct)


def _here(name: str, at: str) -> bool:
    return not at or name not in TOP_LEVEL
