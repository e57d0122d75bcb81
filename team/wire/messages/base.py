"""The base of all messages: types of fields, and shared checks of arrays."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from teamslam.team.core import check_ascending, check_blocks, check_finite, check_packed_covariance
from teamslam.team.wire.arrays import floats, ids

NAME = "^[a-z][a-z0-9_]{0,31}$"
Name = Annotated[str, Meta(pattern=NAME)]
Robot = Annotated[str, Meta(extra_json_schema={"pattern": NAME})]
"""A `Name` of frequent messages, checked by `codec.decoded`: msgspec's own check of a pattern takes
twice as long as all other fields together.
"""
Author = Annotated[str, Meta(pattern="^(map-)?[a-z][a-z0-9_]{0,31}$")]
"""The author of a member of the set: a robot, or a saved map as `map-<name>`."""
Text = Annotated[str, Meta(max_length=20_000)]
Document = Annotated[str, Meta(max_length=1_000_000)]
"""A configuration; the world's has 1,500 characters for each robot."""
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
StampNs = Annotated[int, Meta(ge=-(2**62), lt=2**62)]
Digest = Annotated[bytes, Meta(min_length=8, max_length=8)]
Bias = Literal["bearing", "clock_offset", "forward_scale", "range_offset", "range_scale"]
Real = Annotated[float, Meta(ge=-1e300, le=1e300)]
"""A finite number: the bounds reject NaN and the infinities."""


class Message(msgspec.Struct, frozen=True, kw_only=True, array_like=True, gc=False):
    """A message with its team time."""

    stamp_ns: StampNs

    def check(self) -> None:
        """Raise ValueError if the arrays do not fit together."""


def check_landmarks(id_bytes: bytes, means: bytes, covariance: bytes, *, joint: bool) -> None:
    """Raise ValueError unless ids ascend and means and covariance fit them (joint or blocks)."""
    check_ascending(id_bytes, "ids")
    n = len(id_bytes) // 4
    check_finite(means, "means", 2 * n)
    if joint:
        check_packed_covariance(covariance, 2 * n, "covariance")
        return
    check_blocks(covariance, n, "covariance")


def check_sorted(values: Sequence[Any], what: str) -> None:
    """Raise ValueError unless the values strictly ascend."""
    if any(a >= b for a, b in pairwise(values)):
        raise ValueError(f"not ascending: {what}")


def check_counts(count_bytes: bytes, groups: int, total: int) -> None:
    """Raise ValueError unless there is a count for each group and they sum to the total."""
    counts = ids(count_bytes, "counts")
    if len(counts) != groups or int(counts.sum(dtype="int64")) != total:
        raise ValueError(f"wrong length: counts, {groups} groups of together {total} expected")


def check_classes(class_bytes: bytes, count: int) -> None:
    """Raise ValueError unless there are equally many finite numbers for each landmark."""
    numbers = len(floats(class_bytes, "classes"))
    if numbers and (not count or numbers % count):
        raise ValueError(f"wrong length: classes has {numbers} numbers for {count} landmarks")
    check_finite(class_bytes, "classes", numbers)


def tag_of(message: type[Message]) -> str:
    """Return the tag, "name/version"."""
    return str(message.__struct_config__.tag)
