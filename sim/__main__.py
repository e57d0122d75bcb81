"""`python -m sim` is `teamslam`."""

from sim.cli import main

main()
