"""The experiments by name. Light to import: the command line lists them without loading them."""

from typing import NamedTuple


class Entry(NamedTuple):
    """An experiment: its name on the command line, its module, a line about it.

    seeds: how many there are by default, and with --quick.
    """

    name: str
    module: str
    summary: str
    seeds: int = 30
    quick_seeds: int = 5


ENTRIES = (
    Entry(
        "accuracy",
        "accuracy",
        "The team against the batch optimiser: simulated worlds of all sizes, UTIAS sets, goals.",
        seeds=50,
    ),
)
