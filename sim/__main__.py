"""`python -m teamslam` is `teamslam`."""

import sys

INTERRUPTED = 130  # the exit status of a command that Ctrl-C has ended, as a shell has it


def main() -> None:
    """Run a command."""
    try:
        from teamslam.sim.cli.main import main as run

        run()
    except KeyboardInterrupt:  # while modules are imported; later a command reports it
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
