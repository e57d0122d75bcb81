"""Members of a map's unnamed landmarks, and the associating step of each."""

from teamslam.central.unnamed_landmarks import SHOWN, STEPS
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids


def sets_of(fused: m.FusedMap) -> dict[int, tuple[int, list[str]]]:
    """Number of submaps (in a running map at most SHOWN) and members of each landmark.

    `r1/1/12/7` is robot, incarnation, submap, local landmark: the form that `teamslam verdict`
    reads.
    """
    found: dict[int, tuple[set[tuple[str, int, int]], list[str]]] = {}
    for table in fused.memberships:
        columns = zip(
            ids(table.sequences, "sequences").tolist(),
            ids(table.locals, "locals").tolist(),
            ids(table.identities, "identities").tolist(),
            table.steps,
            floats(table.figures, "figures").reshape(-1, 3).tolist(),
            strict=True,
        )
        for sequence, local, identity, step, (llr, rival, sd) in columns:
            submaps, words = found.setdefault(identity, (set(), []))
            submaps.add((table.robot, table.incarnation, sequence))
            name = f"{table.robot}/{table.incarnation}/{sequence}/{local}"
            if not 0 < step < len(STEPS):
                words.append(name)
                continue
            against = f", its best rival {rival:.1f}" if rival > -1e299 else ", no rival"
            words.append(
                f"{name}: {STEPS[step]}, log-likelihood ratio {min(llr, 1e6):.1f}{against}, "
                f"sd {sd:.2f} m"
            )
    return {number: (len(submaps), words[:SHOWN]) for number, (submaps, words) in found.items()}
