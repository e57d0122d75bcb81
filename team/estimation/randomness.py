"""Random numbers keyed by their use, so that any submap can be computed alone."""

import hashlib

import numpy as np

from teamslam.team import core


def random_numbers(seed: int, robot: str, incarnation: int, sequence: int) -> core.Random:
    """Make the counter-based random numbers (Philox 4x64) of one window.

    The key is the BLAKE2b digest of (seed, robot, incarnation, sequence).
    """
    return core.Random(_key(seed, robot, incarnation, sequence))


def generator(seed: int, robot: str, incarnation: int, sequence: int) -> "np.random.Generator":
    """Make NumPy's generator of the key of `random_numbers`."""
    key = int.from_bytes(_key(seed, robot, incarnation, sequence), "little")
    return np.random.Generator(np.random.Philox(key=key))


def _key(seed: int, robot: str, incarnation: int, sequence: int) -> bytes:
    return hashlib.blake2b(
        f"{seed}/{robot}/{incarnation}/{sequence}".encode(),
        digest_size=16,
        person=b"teamslam window",
    ).digest()
