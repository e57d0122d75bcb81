"""Limits BLAS to one thread in this process, so that a map's bits do not depend on how it was
started.

A BLAS that divides a product among threads sums it in another order, so two threads give other bits
than one. Environment variables are read only when NumPy is loaded, which a user's own script may
have done long ago; the loaded libraries are therefore configured directly when estimation is
imported. NumPy and SciPy bring one each, and the kernels use SciPy's.
"""

import numpy  # noqa: F401
import scipy.linalg  # noqa: F401
from threadpoolctl import ThreadpoolController

ThreadpoolController().limit(limits=1, user_api="blas")
