"""Limits BLAS to one thread in this process, so that a map's bits do not depend on how it was
started.

A BLAS that divides a product among threads sums it in another order, so two threads give other bits
than one. Environment variables are read only when such a library is loaded: NumPy's may have been
loaded by a user's own script long ago, so what is there is configured directly when estimation is
imported. SciPy's is loaded by those who need it, robots do not, and then finds the variables.
"""

import os

import numpy  # noqa: F401
from threadpoolctl import ThreadpoolController

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
ThreadpoolController().limit(limits=1, user_api="blas")
