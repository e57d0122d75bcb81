"""Says how far a long piece of work is."""

import time

import typer

PATIENCE_S = 3.0
"""Time [s] between two lines, and before the first one: short work says nothing."""


class Steps:
    """Prints on stderr, now and then, what is being done and how far it is."""

    def __init__(self) -> None:
        self._what = ""
        self._due = time.monotonic() + PATIENCE_S

    def begin(self, what: str) -> None:
        """Name the next step."""
        self._what = what
        self.at("")

    def share(self, done: float) -> None:
        """So much of the step is done, 0 to 1."""
        self.at(f": {done:.0%}")

    def robot(self, name: str) -> None:
        """The step has come to this robot."""
        self.at(f": {name}")

    def at(self, words: str) -> None:
        """Say these words of the step, if it is time."""
        now = time.monotonic()
        if now >= self._due:
            self._due = now + PATIENCE_S
            typer.echo(f"{self._what}{words}", err=True)
