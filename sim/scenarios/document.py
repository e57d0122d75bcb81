"""Convert a user's TOML document (docs/scenario.md) to the plain fields of a scenario.

Errors name field path, known values and remedy.
"""

import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import msgspec

from teamslam.central.config import CentralConfig
from teamslam.central.desk.names import data_set_name
from teamslam.team.config import RobotConfig
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
                check_known(name, [x for x in types if not at or x not in TOP_LEVEL], at)
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


if TYPE_CHECKING:
    import zipfile

BUILTIN = Path(__file__).with_name("builtin")  # folder of the installed scenarios
MAX_ROBOTS = 1_000
UTIAS_ROBOTS = 5
ANY_ROBOT = "any_robot"  # placeholder for each robot of an unread data set

Fields = dict[str, Any]


def builtin_names() -> tuple[str, ...]:
    """Names of installed scenarios."""
    return tuple(sorted(path.stem for path in BUILTIN.glob("*.toml")))


def builtin_text(name: str) -> str:
    """TOML text of an installed scenario."""
    return (BUILTIN / f"{name}.toml").read_text("utf-8")


def named_document(name: str) -> tuple[Fields, str]:
    """Merged document of a built-in scenario or user file, and its short name: a data set's folder
    or zip.
    """
    if name in builtin_names():
        return _builtin(name), name
    document, path = _resolve_base(own_document(name)), Path(name)
    kind = checked_table(document.get("world", {}), "world").get("kind")
    if path.name == "scenario.toml" and kind not in ("simulated", "live"):
        return document, named_after(path.parent) or path.stem
    return document, path.stem


def named_after(data_set: Path) -> str:
    """Name of a data set's team."""
    return _short_name(data_set_name(data_set.resolve()))


def _short_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text)[:64]


def own_document(name: str) -> Fields:
    """Unmerged document of a user's file; the data set's path becomes relative to the working
    directory.
    """
    archive, path = _file_at(Path(name))
    if path.is_dir():
        raise ScenarioError(
            "a folder, not a scenario: give a .toml file in it; a data set goes with --dataset"
        )
    if not path.is_file() and path.suffix == ".toml":
        raise ScenarioError(f"no such file; built in are {', '.join(builtin_names())}")
    if not path.is_file():
        raise ScenarioError(
            f"no such scenario{close(name, builtin_names())}; built in: "
            f"{', '.join(builtin_names())}; or give a path to a .toml file"
        )
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"can not be read as UTF-8 text: {error}") from None
    document = _parse(text)
    world = document.get("world")
    if isinstance(world, dict) and isinstance(world.get("path"), str) and world["path"]:
        world["path"] = str(archive or Path(name).parent / world["path"])
    return document


def _file_at(path: Path) -> "tuple[Path | None, Path | zipfile.Path]":
    for above in filter(Path.is_file, path.parents):
        import zipfile

        if zipfile.is_zipfile(above):
            return above, zipfile.Path(above, path.relative_to(above).as_posix())
    return None, path


def resolve(document: Fields, stem: str, known: Sequence[str]) -> Fields:
    """Merge defaults into every robot and add names; values are checked where the user wrote them.

    known: fields of a scenario.
    """
    for name in document:
        check_known(name, [*known, "base", "defaults", "robot_count"], "")
    fields: Fields = {"name": _short_name(stem)} | document
    defaults = checked_table(fields.pop("defaults", {}), "defaults")
    _check_part(defaults, RobotConfig, "defaults", {"id": "r1"})
    if "id" in defaults:
        raise ScenarioError("`id` at defaults would be every robot's: give it in [[robots]]")
    count = fields.pop("robot_count", None)
    if count is not None and "robots" in fields:
        raise ScenarioError("robot_count and [[robots]] exclude each other: leave one away")
    world = checked_table(fields.get("world", {}), "world")
    if world.get("kind") == "live" and world.get("admit"):
        fields["world"] = {"newcomer": {"id": "newcomer"} | defaults} | world
    robots = fields.get("robots", _unnamed(world, count))
    if not isinstance(robots, list):
        raise ScenarioError("expected [[robots]], an array of tables, at robots")
    for i, robot in enumerate(robots):
        at = f"robots[{i}]"
        _check_part(checked_table(robot, at), RobotConfig, at, {"id": "r1"})
    fields["robots"] = [
        _merge({"id": f"r{i}"} | defaults, robot) for i, robot in enumerate(robots, 1)
    ]
    _check_part(checked_table(fields.get("central", {}), "central"), CentralConfig, "central", {})
    return {"team": fields["name"]} | fields


def _unnamed(world: Fields, count: object) -> list[Fields]:
    if count is not None:
        return [{}] * checked_count(count)
    if world.get("kind") == "folder":
        from teamslam.sim.datasets.folder_files import robots_of

        path = world.get("path")
        named = robots_of(path) if isinstance(path, str) and path else (ANY_ROBOT,)
        return [{"id": name} for name in named]
    return [{}] * (UTIAS_ROBOTS if world.get("kind") == "utias" else 0)


def checked_table(value: object, at: str) -> Fields:
    """Return a table; raises ScenarioError."""
    if not isinstance(value, dict):
        raise ScenarioError(f"expected a table, got {type(value).__name__} at {at}")
    return value


def checked_count(count: object) -> int:
    """Return a team size; raises ScenarioError."""
    if not isinstance(count, int) or isinstance(count, bool):
        raise ScenarioError(f"expected a number of robots from 1 to {MAX_ROBOTS}, got {count!r}")
    if not 1 <= count <= MAX_ROBOTS:
        raise ScenarioError(f"{count} robots: a team has 1 to {MAX_ROBOTS}")
    return count


def _builtin(name: str) -> Fields:
    return _resolve_base(_parse(builtin_text(name)))


def _parse(text: str) -> Fields:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"not valid TOML: {error}; texts stand in quotes") from None


def _resolve_base(document: Fields) -> Fields:
    if "base" not in document:
        return document
    own = {key: value for key, value in document.items() if key != "base"}
    base = document["base"]
    if base not in builtin_names():
        known = ", ".join(builtin_names())
        hint = close(base, builtin_names())
        if isinstance(base, str) and base.endswith(".toml"):
            hint = "; a file can not be a base: copy what you need of it"
        raise ScenarioError(
            f"expected a built-in scenario, got {base!r} at base; known: {known}{hint}"
        )
    below = _builtin(base)
    kind = own["world"].get("kind") if isinstance(own.get("world"), dict) else None
    if kind is not None and kind != below.get("world", {}).get("kind"):
        below.pop("world", None)  # its fields are another world's
    if "robot_count" in own:
        below.pop("robots", None)
    return _merge(below, own)


def _merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> Fields:
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        both = isinstance(old, dict) and isinstance(value, dict)
        merged[key] = _merge(old, value) if both and old is not None else value
    return merged


def _check_part(value: Fields, declared: type[msgspec.Struct], at: str, needed: Fields) -> None:
    check_fields(value, declared, at)
    try:
        msgspec.convert(needed | value, declared)
    except msgspec.ValidationError as error:
        raise plain_error(error, at, needed | value) from None
