"""`python -m teamslam` is the command `teamslam`."""

from teamslam.sim.__main__ import main

if __name__ == "__main__":
    main()
