"""`python -m sim` is `teamslam`; what `launch` forks its processes from begins here, too."""

import sys

from sim.cli.main import command, main

if sys.argv[1:2] == ["template"]:
    from sim.launch.template import become_a_process, end_by

    become_a_process(command)  # returns in a forked process, with the words of its own command
    end_by(main)
main()
