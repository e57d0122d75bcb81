"""`python -m sim` is `teamslam`."""

from sim.cli.main import main

main()
