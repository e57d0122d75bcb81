"""The priors of a graph, of poses and of biases, all in one compiled call."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from team.estimation.compiled import compiled
from team.estimation.geometry import wrapped


class PriorFactors(NamedTuple):
    """The priors N(mean, information⁻¹) of the numbers begin … begin + size − 1 of the state: a
    pose (x, y, theta) or one number. Means and matrices are padded with zeros.
    """

    begin: Int64[np.ndarray, " priors"]
    size: Int64[np.ndarray, " priors"]
    mean: Float[np.ndarray, "priors 3"]
    information: Float[np.ndarray, "priors 3 3"]


@compiled
def prior_terms(
    state: Float[np.ndarray, " n"], priors: PriorFactors
) -> tuple[Float[np.ndarray, "priors 3"], Float[np.ndarray, " priors"]]:
    """P⁻¹r and rᵀP⁻¹r of each prior; the slope of one of fewer numbers ends in zeros."""
    slopes, chi2 = np.zeros((len(priors.begin), 3)), np.zeros(len(priors.begin))
    r = np.zeros(3)
    for k in range(len(priors.begin)):
        begin, size = priors.begin[k], priors.size[k]
        for i in range(size):
            r[i] = state[begin + i] - priors.mean[k, i]
        if size == 3:
            r[2] = wrapped(r[2])
        for i in range(size):
            for j in range(size):
                slopes[k, i] += priors.information[k, i, j] * r[j]
            chi2[k] += r[i] * slopes[k, i]
    return slopes, chi2
