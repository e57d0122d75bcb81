"""Compiled kernels of the priors of a graph, of poses and of biases."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from team.estimation.compiled import compiled
from team.estimation.geometry import wrapped


class PriorFactors(NamedTuple):
    """The priors N(mean, information⁻¹) of the numbers begin … begin + size − 1 of the state: a
    pose (x, y, theta) or one number. Means and matrices are padded with zeros.
    """

    node: Int64[np.ndarray, " priors"]
    begin: Int64[np.ndarray, " priors"]
    size: Int64[np.ndarray, " priors"]
    mean: Float[np.ndarray, "priors 3"]
    information: Float[np.ndarray, "priors 3 3"]


@compiled
def prior_terms(
    state: Float[np.ndarray, " n"], priors: PriorFactors
) -> tuple[Float[np.ndarray, "priors 3"], Float[np.ndarray, " priors"]]:
    """Compute P⁻¹r and rᵀP⁻¹r of each prior, padded with zeros."""
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


@compiled
def add_priors(
    values: Float[np.ndarray, " _"],
    gradient: Float[np.ndarray, " n"],
    priors: PriorFactors,
    slopes: Float[np.ndarray, "priors 3"],
    weights: Float[np.ndarray, " priors"],
    at: Int64[np.ndarray, " priors"],
) -> None:
    """Add each prior, times its weight, to half the gradient and to the values of a block pattern.

    at: index of its node's diagonal block. slopes: of `prior_terms`.
    """
    for k in range(len(weights)):
        size = priors.size[k]
        for i in range(size):
            gradient[priors.begin[k] + i] += weights[k] * slopes[k, i]
            for j in range(size):
                values[at[k] + i * size + j] += weights[k] * priors.information[k, i, j]
