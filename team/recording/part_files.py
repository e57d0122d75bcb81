"""The files of a log: a recorder that is started again writes a further part.

`log.part2.mcap` is the second part of `log.mcap`. Parts of one log have one LOG_ID in their
metadata. A log that was joined of parts names the last of them in JOINED: parts up to this number
are in it, and files of them that a crash has left are not read.
"""

from contextlib import suppress
from pathlib import Path

from team.recording.opening import LogFile, open_file
from team.recording.records import LogError

LOG_ID = "log_id"
"""Name of the metadata that all parts of one log share."""
JOINED = "joined"
"""Name of the metadata with the number of the last part that was joined into a log."""


def part_of(path: Path, number: int) -> Path:
    """The path of a part of the log at `path`; the first is the log itself."""
    return path if number == 1 else path.with_name(f"{path.stem}.part{number}{path.suffix}")


def parts_of(path: Path) -> list[Path]:
    """The existing files of the log at `path`, in order; without those that were joined into it.

    A file of a part's name that belongs to another log is not among them.
    """
    numbered = _numbered_parts(path)
    opened = {number: open_part(part) for number, part in numbered.items()}
    first = next((log for log in opened.values() if log is not None), None)
    joined = _joined(opened.get(1))
    return [
        part
        for number, part in numbered.items()
        if number == 1 or (number > joined and _is_of(first, opened[number], part))
    ]


def next_number(path: Path) -> int:
    """The number of the next part of the log at `path`: larger than that of each earlier one."""
    numbered = _numbered_parts(path)
    return max((_joined(open_part(path)), *numbered)) + 1 if numbered else 1


def joined_leftovers(path: Path) -> list[Path]:
    """The files of parts that were joined into the log at `path` and that a crash has left."""
    first = open_part(path)
    return [
        part
        for number, part in _numbered_parts(path).items()
        if 1 < number <= _joined(first) and _is_of(first, open_part(part), part)
    ]


def _numbered_parts(path: Path) -> dict[int, Path]:
    """The files that have the name of the log, or of a part of it, by their number.

    None where there is no first one: parts without it are another log's, which was moved.
    """
    if not path.exists():
        return {}
    found = {1: path}
    begin = f"{path.stem}.part"
    for each in path.parent.iterdir():
        number = each.name.removeprefix(begin).removesuffix(path.suffix)
        if number.isascii() and number.isdigit() and each == part_of(path, int(number)):
            found[int(number)] = each
    return dict(sorted(found.items()))


def _joined(log: LogFile | None) -> int:
    """The number of the last part that is in the first file of a log."""
    number = "" if log is None else log.metadata.get(JOINED, "")
    return int(number) if number.isascii() and number.isdigit() else 1


def _is_of(first: LogFile | None, log: LogFile | None, path: Path) -> bool:
    """Whether the part at `path` is of the same log as the first file; an empty one may be.

    Logs of earlier versions have no LOG_ID: their team and scenario are compared.
    """
    if first is None or log is None:
        return path.stat().st_size == 0
    same = LOG_ID, "scenario"
    return first.team == log.team and all(
        first.metadata.get(name) == log.metadata.get(name) for name in same
    )


def open_part(path: Path) -> LogFile | None:
    """One file as a log; None where it is none, as of a recorder that ended before it began."""
    with suppress(LogError):
        return open_file(path)
    return None
