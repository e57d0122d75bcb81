"""Progress of long work as plain lines on stderr, for terminals and log files alike."""

import time

import typer

PATIENCE_S = 3.0
"""Time [s] between two lines, and before the first one, so that short work prints none."""


class Steps:
    """Print the current step and its progress, at most one line in PATIENCE_S."""

    def __init__(self) -> None:
        self._what = ""
        self._due = time.monotonic() + PATIENCE_S

    def begin(self, what: str) -> None:
        """Name the next step."""
        self._what = what
        self.print_if_due("")

    def share(self, done: float) -> None:
        """Report the share of the step that is done, 0 to 1."""
        self.print_if_due(f": {done:.0%}")

    def robot(self, name: str) -> None:
        """Report the robot that the step has reached."""
        self.print_if_due(f": {name}")

    def print_if_due(self, words: str) -> None:
        """Print the step with these words, if a line is due."""
        now = time.monotonic()
        if now >= self._due:
            self._due = now + PATIENCE_S
            typer.echo(f"{self._what}{words}", err=True)
