"""Bits of the estimation's functions as digests; run it for a table.

python -m tests.estimation.arithmetic
"""

import hashlib
import json

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense

SIZES = (3, 40, 130)  # dense matrices: by loops, by a part of a tile, by several tiles and blocks


def digests() -> dict[str, str]:
    x = np.concatenate([0.08 * np.arange(-500.0, 500.0), np.ldexp(1.37, np.arange(-1000, 1000))])
    found = {
        "sin": core.sin(x),
        "cos": core.cos(x),
        "atan2": core.atan2(x, x[::-1].copy()),
        "exp": core.exp(x),
        "log": core.log(np.abs(x)),
    }
    for n in SIZES:
        A = (core.sin(np.arange(1.0, 1.0 + n * n)) + 0.1).reshape(n, n)
        found |= {
            f"product {n}": dense.product(A, A),
            f"product with a vector {n}": dense.product(A, A[0]),
            f"inner product {n}": dense.product(A[0], A[1]),
            f"cholesky {n}": dense.cholesky(dense.product(A, A.T) + np.eye(n)),
        }
    return {
        name: hashlib.sha256(values.tobytes()).hexdigest()[:16] for name, values in found.items()
    }


if __name__ == "__main__":
    print(json.dumps([core.level, digests()]))
