"""One submap beside another one: what fragments of landmarks keep from being told apart."""

import numpy as np
from jaxtyping import Bool, Float

from team.association import AssociationProfile
from team.estimation.association.gating import Joint, list_pairs
from team.estimation.association.island_view import (
    REEXAMINED,
    find_undecided,
    select_by_turns,
    select_comparisons,
)
from team.estimation.association.joint_compatibility import assign_jointly

OWN = 0.01
PROFILE = AssociationProfile(slack=0.0, density=1.0)
TWINS = np.array([(0.0, 0.0), (0.2, 0.0), (3.0, 1.0), (3.0, 1.2)])


def _seen(submaps: list[list[int]], common: float) -> tuple[Joint, list[np.ndarray]]:
    """The same twins as several submaps saw them, each with an error that its landmarks share and
    each landmark with one of its own, of these standard deviations.
    """
    rng = np.random.default_rng(1)
    owner = np.repeat(np.arange(len(submaps)), [len(each) for each in submaps])
    together: Bool[np.ndarray, "n n"] = owner[:, None] == owner[None]
    shared = common**2 * np.kron(together, np.eye(2))
    covariance: Float[np.ndarray, "m m"] = OWN**2 * np.eye(2 * len(owner)) + shared
    apart = together & ~np.eye(len(owner), dtype=np.bool_)
    points = TWINS[[k for each in submaps for k in each]]
    points = points + common * rng.normal(size=(len(submaps), 2))[owner]
    points = points + OWN * rng.normal(size=points.shape)
    return Joint(points, covariance, apart), [
        np.flatnonzero(owner == k) for k in range(len(submaps))
    ]


def _rows(submaps: list[np.ndarray], joint: Joint) -> Bool[np.ndarray, "K n"]:
    return np.array([np.isin(np.arange(len(joint.mean)), each) for each in submaps])


def _pairs(joint: Joint, own: np.ndarray, candidates: np.ndarray) -> list[tuple[int, int]]:
    found = assign_jointly(joint, *list_pairs(own, candidates), PROFILE, 0.5)
    return sorted((pair.first, pair.second) for pair in found.pairs)


def test_fragments_that_wait_do_not_keep_a_submap_from_being_told_apart():
    joint, (own, *others) = _seen([[0, 1, 2, 3]] * 5, common=0.15)
    assert not _pairs(joint, own, np.concatenate(others))
    found = set()
    for candidates in select_comparisons(joint, own, _rows(others, joint), PROFILE, 0.5):
        found |= {(one, two % 4) for one, two in _pairs(joint, own, candidates)}
    assert found == {(k, k) for k in range(4)}


def test_what_the_other_submap_missed_is_a_rival_of_what_it_has():
    joint, (own, other, whole) = _seen([[1], [0], [0, 1]], common=0.04)
    fits = select_comparisons(joint, own, _rows([other], joint), PROFILE, 0.5)
    assert [each.tolist() for each in fits] == [other.tolist()]
    apart = joint.apart.copy()
    apart[other, whole[1]] = apart[whole[1], other] = True  # one keyframe saw the two together
    with_rival = select_comparisons(
        joint._replace(apart=apart), own, _rows([other], joint), PROFILE, 0.5
    )
    assert [each.tolist() for each in with_rival] == [other.tolist()]
    both = select_comparisons(
        joint._replace(apart=apart), own, _rows([other, whole], joint), PROFILE, 0.5
    )
    assert [other[0], whole[1]] in [each.tolist() for each in both]


def test_undecided_are_those_that_may_be_one():
    joint, (one, two) = _seen([[0, 1], [0, 2]], common=0.15)
    assert find_undecided(joint, np.arange(4), PROFILE).tolist() == [one[0], one[1], two[0]]


def test_every_older_submap_is_examined_again_by_turns():
    submaps = list(range(100, 130))
    seen = [select_by_turns(submaps, turn) for turn in range(len(submaps))]
    assert set().union(*seen) == set(submaps)
    assert all(len(each) == len(set(each)) <= REEXAMINED for each in seen)
    assert select_by_turns(submaps[:REEXAMINED], 3) == submaps[:REEXAMINED]
