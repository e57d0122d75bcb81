"""Limit BLAS to one thread, so that a map's bits do not depend on how the process was started.

A BLAS that divides a product among threads sums it in another order. Environment variables are read
only when such a library is loaded: loaded ones are configured directly when estimation is imported;
SciPy's, which robots do not load, then reads the variables.
"""

import os

import numpy  # noqa: F401
from threadpoolctl import ThreadpoolController

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
ThreadpoolController().limit(limits=1, user_api="blas")
