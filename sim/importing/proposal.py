"""Propose a column map from the names of files and columns."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from teamslam.sim.datasets.csv_table import CsvTable
from teamslam.sim.datasets.folder_files import ROBOT_NAME
from teamslam.sim.datasets.folder_tables import DEGREE, POINTS, POLAR, POSES
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.importing.tables import (
    FUSED_WORDS,
    MEASURED,
    REQUIRED,
    TABLES,
    TRUTH_WORDS,
    has_word,
    names_robot,
)

SYNONYMS: Mapping[str, str] = {
    "t_s": "t time times timestamp stamp sec secs seconds ts epoch unix unix_time header_stamp",
    "forward_m_s": "v vx v_x vel vel_x speed velocity forward forward_speed forward_velocity "
    "forward_vel linear linear_x lin_x linear_vel linear_velocity linear_velocity_x lin_vel "
    "ground_speed longitudinal longitudinal_speed speed_x velocity_x",
    "yaw_rate_rad_s": "w w_z wz omega omega_z yaw_rate yaw_vel yaw_velocity turn_rate turning_rate "
    "rotation_rate rot_rate rot_vel heading_rate theta_dot yaw_dot dtheta_dt vth vtheta v_theta "
    "angular angular_z ang_z angular_speed angular_vel angular_velocity angular_velocity_z ang_vel "
    "gyro gyro_z gyr gyr_z gz gyro_yaw imu_gyro imu_gyro_z imu_yaw_rate "
    "imu_angular_velocity_z",
    "x_m": "x forward ahead rel_x local_x pos_x x_pos px easting east",
    "y_m": "y left rel_y local_y pos_y y_pos py northing north",
    "theta_rad": "theta yaw heading phi psi orientation angle_z rot_z",
    "dx_m": "dx delta_x",
    "dy_m": "dy delta_y",
    "dtheta_rad": "dtheta dyaw delta_theta delta_yaw dphi dheading delta_heading",
    "wheel_speed_m_s": "rear_wheel_speed wheel_speed wheel_velocity",
    "steering_rad": "steering steering_angle steer steer_angle",
    "landmark": "id ids tag tag_id marker marker_id barcode landmark_id lm lm_id subject feature "
    "feature_id beacon beacon_id fiducial fiducial_id aruco aruco_id apriltag apriltag_id target "
    "target_id",
    "teammate": "robot robot_id other other_robot teammate_id neighbour neighbor",
    "range_m": "range ranges r distance dist rho rng",
    "bearing_rad": "bearing bearings beta angle azimuth brg",
}
"""Column names as words, separated by nothing, a mark or a capital letter."""
UNITS = {
    "s": "1", "sec": "1", "ms": "1e-3", "msec": "1e-3", "us": "1e-6", "usec": "1e-6", "ns": "1e-9",
    "nsec": "1e-9", "nanos": "1e-9", "m": "1", "mm": "1e-3", "cm": "1e-2", "km": "1e3",
    "rad": "1", "radians": "1", "deg": DEGREE, "degrees": DEGREE,
    "m_s": "1", "mps": "1", "cm_s": "1e-2", "mm_s": "1e-3", "km_h": "0.2777777777777778",
    "kmh": "0.2777777777777778", "kph": "0.2777777777777778", "rad_s": "1", "rad_sec": "1",
    "rps": "1", "deg_s": DEGREE, "deg_sec": DEGREE, "dps": DEGREE,
}  # fmt: skip
"""Factor to our unit, by the unit at the end of a column name."""
LARGEST_S = 1e11  # times from here on are no seconds
MOST_ROBOTS = 100  # more values of a column are no names of robots
_NONE: Mapping[str, Any] = MappingProxyType({})
PROPOSED = (*MEASURED, "truth", "landmarks", "start")
FILE_NAMES: Mapping[str, Sequence[str]] = {
    "odometry": ("odom", "wheel", "encoder"),
    "observations": ("observ", "tags", "detection", "marker"),
    "detections": ("detection", "cone", "pole", "tree", "corner", "feature"),
    "sightings": ("sighting",),
    "truth": (),
    "landmarks": ("landmark",),
    "start": ("start",),
}
"""Parts of file names that indicate a table kind."""
PREFIXES = ("odometry", "odom", "pose", "position", "robot", "base", "wheel", "truth", "gt", "tag",
            "marker", "landmark", "twist", "encoder", "measured", "measurement", "header",
            "field", "true", "groundtruth", "ref", "reference", "mocap", "optitrack",
            "vicon")  # fmt: skip
"""Prefixes of column names that repeat the file's kind: odom_x, pose.position.y."""


class _Guess(NamedTuple):
    """Probable table of a file; a higher rank is better."""

    file: str
    kind: str
    columns: dict[str, str]
    is_named: bool
    rank: tuple[int, int]


class _Proposed(NamedTuple):
    """Table of a file; columns: TOML value of theirs by ours."""

    file: str
    columns: Mapping[str, str]

    def uses(self, column: str) -> bool:
        return any(f'"{column}"' in theirs for theirs in self.columns.values())


Files = Mapping[str, CsvTable]  # tables of one robot by file name
Drop = tuple[str, Sequence[str]]  # a column, and its texts in rows of other robots
Drops = Mapping[str, Mapping[str, Drop]]  # by robot and file


def propose_map(robots: Mapping[str, Files], *, own: bool = False, drops: Drops = _NONE) -> str:
    """Propose a TOML map for the files of each robot.

    A table that not all robots have alike, with `own` every table, is `[robots.NAME.KIND]`. A file
    is the truth of one robot. A robot without odometry gets the expected file. The rest is
    comments.
    """
    found = {robot: _tables(files) for robot, files in robots.items()}
    _drop_shared_truth(robots, found, drops)
    comments = _add_odometry(found)
    shared: list[str] = []
    by_robot: dict[str, list[str]] = {robot: [] for robot in robots}
    for kind in dict.fromkeys(kind for tables, _ in found.values() for kind in tables):
        of = {
            robot: (tables[kind], drops.get(robot, _NONE).get(tables[kind].file))
            for robot, (tables, _) in found.items()
            if kind in tables
        }
        left = {
            robot: _unassigned(found[robot][0], robots[robot], *table)
            for robot, table in of.items()
        }
        first, *others = of.values()
        if len(of) == len(found) and all(each == first for each in others) and not own:
            shared.append(_text(kind, *first, chain(*left.values())))
            continue
        for robot, table in of.items():
            by_robot[robot].append(_text(f"robots.{robot}.{kind}", *table, left[robot]))
    lacking = dict.fromkeys(
        f"# {robot}: {line}\n" if len(found) > 1 else f"# {line}\n"
        for robot, (_, lines_of) in found.items()
        for line in lines_of
    )
    return comments + "\n".join([*shared, *chain(*by_robot.values())]) + "".join(lacking)


def _unassigned(
    tables: Mapping[str, _Proposed], files: Files, table: _Proposed, drop: Drop | None
) -> list[str]:
    """Columns of a file that neither its tables nor the `drop` have."""
    beside = [each for each in tables.values() if each.file == table.file]
    columns = files[table.file].columns if table.file in files else ()
    used = {column for column in columns if any(each.uses(column) for each in beside)}
    return [each for each in columns if each not in used and each != (drop or ("",))[0]]


def _text(name: str, table: _Proposed, drop: Drop | None, left: Iterable[str]) -> str:
    lines = [f"[{name}]", f'files = ["{table.file}"]', *([drop_line(*drop)] if drop else [])]
    lines += [f"[{name}.columns]", *(f"{ours} = {text}" for ours, text in table.columns.items())]
    names = ", ".join(dict.fromkeys(left))
    lines += [f"# not assigned: {names}"] if names else []
    return "\n".join([*lines, ""])


def drops_by_robot(files: Files) -> Drops:
    """Rows of others in tables of several robots, by a column that names them; empty if the
    odometry has none.
    """
    tables = _tables(files)[0]
    columns = {
        table.file: column
        for table in tables.values()
        for column, cells in files[table.file].columns.items()
        if names_robot(column) and not table.uses(column) and 1 < len(set(cells)) <= MOST_ROBOTS
    }
    if "odometry" not in tables or tables["odometry"].file not in columns:
        return {}
    values = {
        name: list(dict.fromkeys(files[name].columns[column])) for name, column in columns.items()
    }
    robots = {
        (f"r{value}" if value.isdigit() else value.lower()): value
        for value in chain(*values.values())
    }
    whole = len(robots) == len(set(chain(*values.values())))
    if not whole or not all(re.fullmatch(ROBOT_NAME, robot) for robot in robots):
        return {}
    return {
        robot: {
            name: (column, [other for other in values[name] if other != own])
            for name, column in columns.items()
        }
        for robot, own in robots.items()
    }


def drop_line(column: str, texts: Sequence[str]) -> str:
    """Line of a map that drops the rows with these texts."""
    key = column if re.fullmatch(r"[A-Za-z0-9_-]+", column) else json.dumps(column)
    return f"drop = {{ {key} = {json.dumps(texts, ensure_ascii=False)} }}"


def _drop_shared_truth(
    robots: Mapping[str, Files],
    found: Mapping[str, tuple[dict[str, _Proposed], list[str]]],
    drops: Drops,
) -> None:
    files = {
        robot: tables["truth"].file
        for robot, (tables, _) in found.items()
        if "truth" in tables and tables["truth"].file not in drops.get(robot, _NONE)
    }
    for robot, file in files.items():
        table = robots[robot][file]
        if any(other != robot and robots[other].get(file) is table for other in robots):
            tables, comments = found[robot]
            del tables["truth"]
            comments.append(f"{file}: whose truth? It goes into [robots.NAME.truth]")


def _add_odometry(found: Mapping[str, tuple[dict[str, _Proposed], list[str]]]) -> str:
    comments = ""
    models = {
        robot: tables["odometry"] for robot, (tables, _) in found.items() if "odometry" in tables
    }
    for robot, (tables, _) in found.items():
        if "odometry" in tables:
            continue
        for other, model in models.items():
            if other in _words(model.file):
                file = re.sub(rf"(?i)(?<![a-z0-9]){other}(?![a-z0-9])", robot, model.file)
                tables["odometry"] = model._replace(file=file)
                comments += f"# {robot} has no odometry: expected {file}, as {model.file}\n"
                break
    return comments


class ProposalWrittenError(DatasetError):
    """A proposal is written; the text is the next step."""


def write_proposal(text: str, path: Path) -> ProposalWrittenError:
    """Write a proposal to the missing file of an option; returns the request to check it."""
    try:
        path.write_text(text, "utf-8")
    except OSError as error:
        raise DatasetError(f"{path}: can not be written: {error.strerror}") from None
    return ProposalWrittenError(
        f"next step: check {path}, which now has this proposal, and repeat the command. Nothing is "
        f"imported yet, hence status 2.\n\n{text}"
    )


def proposed_kinds(files: Files) -> set[str]:
    """Kinds of table that the files probably are."""
    return set(_tables(files)[0])


def split_by_robot(files: Files) -> dict[str, Files]:
    """Files of each robot by the first or last words of their names; empty for fewer than two.

    A robot has odometry and measurements; beside one, a name with one of both in a file called
    alike is enough. Files without a robot's name are every robot's.
    """
    for position in (0, -1):
        words = {name: _words(name)[position] for name in files}
        robots = {
            word: {name: files[name] for name in files if words[name] == word}
            for word in dict.fromkeys(words.values())
            if re.fullmatch(ROBOT_NAME, word)
        }
        kinds = {word: proposed_kinds(of) for word, of in robots.items()}
        whole = {
            word
            for word in robots
            if "odometry" in kinds[word] and len(kinds[word].intersection(MEASURED)) > 1
        }
        known = {_words_without(name, word) for word in whole for name in robots[word]}
        robots = {
            word: of
            for word, of in robots.items()
            if word in whole
            or (
                kinds[word].intersection(MEASURED)
                and not known.isdisjoint(_words_without(name, word) for name in of)
            )
        }
        if len(robots) > 1:
            return {
                robot: {
                    name: table
                    for name, table in files.items()
                    if robot in _words(name) or robots.keys().isdisjoint(_words(name))
                }
                for robot in robots
            }
    return {}


def _words_without(name: str, robot: str) -> tuple[str, ...]:
    return tuple(word for word in _words(name) if word != robot)


def _words(name: str) -> list[str]:
    return re.split(r"[^a-z0-9]+", Path(name).stem.lower())


def _tables(files: Files) -> tuple[dict[str, _Proposed], list[str]]:
    """Probable tables by kind, and comments on others."""
    guesses: list[_Guess] = []
    lacking: list[str] = []
    for name, table in files.items():
        header = list(table.columns)
        found = _guesses(name, header)
        guesses += found
        if not found:
            lacking.append(f"{name}: no table of ours by its columns' names: {', '.join(header)}")
    best: dict[str, _Guess] = {}
    for guess in sorted(guesses, key=lambda each: each.rank, reverse=True):  # stable
        best.setdefault(guess.kind, guess)
    tables: dict[str, _Proposed] = {}
    for guess in guesses:
        kind = guess.kind
        if best[kind] is not guess:
            lacking.append(f"{guess.file}: might be {kind}, too")
            continue
        columns = guess.columns | _clock(guess.columns.get("t_s", ""), files[guess.file])
        tables[kind] = _Proposed(guess.file, columns)
        lacking += [
            f"{guess.file}: nothing for {ours}" for ours in REQUIRED[kind] if ours not in columns
        ]
    return tables, lacking


def _guesses(name: str, header: Sequence[str]) -> list[_Guess]:
    """Table with most of these columns, then by file name; and truth, of reference columns."""
    reference = [each for each in header if has_word(each, TRUTH_WORDS)]
    is_reference = has_word(Path(name).stem, TRUTH_WORDS)
    own = [each for each in header if each not in reference]
    found = [
        guess
        for kind in PROPOSED
        if not (is_reference and kind in MEASURED)
        and (guess := _guess(name, kind, own if kind in MEASURED else header)) is not None
    ]
    if not found:
        return []
    best = max(found, key=lambda g: (g.is_named, g.kind in MEASURED, len(g.columns)))
    if best.kind != "odometry" or not reference:
        return [best]
    clock = [each for each in own if _near("t_s", [each])]
    truth = _guess(name, "truth", [*clock, *reference])
    return [best] if truth is None else [best, truth]


def _guess(name: str, kind: str, header: Sequence[str]) -> _Guess | None:
    found = {ours: near for ours in TABLES[kind] if (near := _near(ours, header)) is not None}
    columns = _of_one_form(kind, found)
    whole = all(ours in columns for ours in REQUIRED[kind]) and len(columns) > 2
    if kind == "detections":
        whole &= any(all(ours in columns for ours in form) for form in (POLAR, POINTS))
    named = any(word in name.lower() for word in FILE_NAMES[kind])
    named |= kind == "truth" and has_word(Path(name).stem, TRUTH_WORDS)
    rank = int(named), -int(has_word(Path(name).stem, FUSED_WORDS))
    return _Guess(name, kind, columns, named, rank) if whole else None


def _of_one_form(kind: str, columns: dict[str, str]) -> dict[str, str]:
    left_out: Sequence[str] = ()
    if kind == "odometry" and "forward_m_s" in columns:
        left_out = POSES
    elif "range_m" in columns:
        left_out = POINTS
    return {ours: theirs for ours, theirs in columns.items() if ours not in left_out}


def _near(ours: str, header: Sequence[str]) -> str | None:
    names = {_join_words(name) for name in SYNONYMS.get(ours, "").split()}
    names.add(_join_words(_without_unit(ours)[0]))
    for theirs in header:
        bare, scale = _without_unit(theirs)
        if (
            theirs == ours
            or _join_words(bare) in names
            or _join_words(_without_prefix(bare)) in names
        ):
            if scale == "1" or theirs == ours:
                return f'"{theirs}"'
            return f'{{ column = "{theirs}", scale = {scale} }}'
    return None


def _without_unit(name: str) -> tuple[str, str]:
    """Lower-case name without unit, and the unit's factor."""
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)
    plain = re.sub(r"[^a-z0-9]+", "_", words.lower()).strip("_")
    for unit in sorted(UNITS, key=len, reverse=True):
        if plain.endswith(f"_{unit}"):
            return plain.removesuffix(f"_{unit}"), UNITS[unit]
    return plain, "1"


def _without_prefix(name: str) -> str:
    first, _, rest = name.partition("_")
    return _without_prefix(rest) if rest and first in PREFIXES else name


def _join_words(name: str) -> str:
    return name.replace("_", "")


def _clock(chosen: str, table: CsvTable) -> dict[str, str]:
    """Time column with a scale, if its numbers are no seconds."""
    cells = table.columns.get(chosen.strip('"'), [])
    try:
        largest = abs(float(cells[0]))
    except (IndexError, ValueError):
        return {}
    power = 0
    while largest >= LARGEST_S and power < 9:
        largest, power = largest * 1e-3, power + 3
    return {"t_s": f"{{ column = {chosen}, scale = 1e-{power} }}"} if power else {}
