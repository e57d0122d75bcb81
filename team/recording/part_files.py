"""Files of a log: a restarted recorder writes a further part.

`log.part2.mcap` is the second part of `log.mcap`. Parts share a LOG_ID in their metadata. A joined
log names its last part in JOINED; leftover files up to that part are not read.
"""

from contextlib import suppress
from pathlib import Path

from teamslam.team.recording.opening import LogFile, open_file
from teamslam.team.recording.records import LogError

LOG_ID = "log_id"
JOINED = "joined"


def part_of(path: Path, number: int) -> Path:
    """Return the path of a part; the first is the log itself."""
    return path if number == 1 else path.with_name(f"{path.stem}.part{number}{path.suffix}")


def parts_of(path: Path) -> list[Path]:
    """Return the files of a log in order, without joined parts and parts of another log."""
    numbered = _numbered_parts(path)
    opened = {number: open_part(part) for number, part in numbered.items()}
    first = next((log for log in opened.values() if log is not None), None)
    joined = _last_joined(opened.get(1))
    return [
        part
        for number, part in numbered.items()
        if number == 1 or (number > joined and _is_of(first, opened[number], part))
    ]


def next_number(path: Path) -> int:
    """Return the number of the next part, above all earlier ones."""
    numbered = _numbered_parts(path)
    return max((_last_joined(open_part(path)), *numbered)) + 1 if numbered else 1


def joined_leftovers(path: Path) -> list[Path]:
    """Return the leftover files of joined parts."""
    first = open_part(path)
    return [
        part
        for number, part in _numbered_parts(path).items()
        if 1 < number <= _last_joined(first) and _is_of(first, open_part(part), part)
    ]


def _numbered_parts(path: Path) -> dict[int, Path]:
    """List a log's files by number; none without a first file: they belong to a moved log."""
    if not path.exists():
        return {}
    found = {1: path}
    begin = f"{path.stem}.part"
    for each in path.parent.iterdir():
        number = each.name.removeprefix(begin).removesuffix(path.suffix)
        if number.isascii() and number.isdigit() and each == part_of(path, int(number)):
            found[int(number)] = each
    return dict(sorted(found.items()))


def _last_joined(log: LogFile | None) -> int:
    number = "" if log is None else log.metadata.get(JOINED, "")
    return int(number) if number.isascii() and number.isdigit() else 1


def _is_of(first: LogFile | None, log: LogFile | None, path: Path) -> bool:
    """Return whether a part belongs to the first file's log; an empty one may.

    Logs of earlier versions have no LOG_ID: their team and scenario are compared.
    """
    if first is None or log is None:
        return path.stat().st_size == 0
    same = LOG_ID, "scenario"
    return first.team == log.team and all(
        first.metadata.get(name) == log.metadata.get(name) for name in same
    )


def open_part(path: Path) -> LogFile | None:
    """Open one file as a log; None if invalid, as after an early end of its recorder."""
    with suppress(LogError):
        return open_file(path)
    return None
