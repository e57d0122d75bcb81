"""One thread of BLAS in this process, whoever began it: a map's bits must not depend on the entry.

A BLAS that cuts a product among threads sums it in another order, so two threads give other bits
than one. Variables of the environment are heard only before NumPy is loaded, which a user's own
script may have done long ago; so the libraries themselves are told, when estimation is imported.
NumPy and SciPy bring one each, the kernels use SciPy's, and only what is loaded can be told.
"""

import numpy  # noqa: F401
import scipy.linalg  # noqa: F401
from threadpoolctl import ThreadpoolController

ThreadpoolController().limit(limits=1, user_api="blas")
