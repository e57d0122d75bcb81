"""`python -m sim` is `teamslam`; the template of `launch` begins here, too."""

import sys

INTERRUPTED = 130
"""The exit status of a command that Ctrl-C has ended, as a shell has it."""


def main() -> None:
    """Run a command. Of `launch` the template is started before anything else is imported."""
    try:
        if sys.argv[1:2] == ["launch"] and "--help" not in sys.argv:
            _launch()
        else:
            _run()
    except KeyboardInterrupt:  # while modules are imported; later a command reports it
        sys.exit(INTERRUPTED)


def _launch() -> None:
    from sim.launch.ahead import end_ahead, start_ahead

    start_ahead()
    try:
        _run()
    finally:
        end_ahead()


def _run() -> None:
    from sim.cli.main import main as run

    run()


if __name__ == "__main__":
    if sys.argv[1:2] == ["template"]:
        from sim.cli.main import prepare_commands
        from sim.launch.template import become_a_process, end_by

        become_a_process(
            prepare_commands
        )  # returns in a forked process, with the words of its own command
        end_by(_run)
    main()
