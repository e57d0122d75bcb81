"""Random numbers keyed by their use: any submap can be computed again alone."""

import hashlib

import numpy as np


def generator(seed: int, robot: str, incarnation: int, sequence: int) -> np.random.Generator:
    """Make the counter-based generator (Philox 4x64) of one window of one robot.

    Its 128-bit key is the BLAKE2b digest of (seed, robot, incarnation, sequence), so streams of
    different windows are independent, and none depends on the draws of another.
    """
    digest = hashlib.blake2b(
        f"{seed}/{robot}/{incarnation}/{sequence}".encode(),
        digest_size=16,
        person=b"teamslam window",
    ).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(digest, "little")))
