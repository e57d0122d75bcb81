"""Progress of long work as plain stderr lines, for terminals and log files."""

import time

import typer

PATIENCE_S = 3.0
"""Time [s] between lines and before the first, so short work prints none."""


class Steps:
    """Print the current step and its progress, at most once in PATIENCE_S."""

    def __init__(self) -> None:
        self._what = ""
        self._due = time.monotonic() + PATIENCE_S

    def begin(self, what: str) -> None:
        """Begin the next step."""
        self._what = what
        self.print_if_due("")

    def share(self, done: float) -> None:
        """Report the completed share of the step, 0 to 1."""
        self.print_if_due(f": {done:.0%}")

    def robot(self, name: str) -> None:
        """Report the robot that the step has reached."""
        self.print_if_due(f": {name}")

    def print_if_due(self, words: str) -> None:
        """Print the step with this text, if a line is due."""
        now = time.monotonic()
        if now >= self._due:
            self._due = now + PATIENCE_S
            typer.echo(f"{self._what}{words}", err=True)
