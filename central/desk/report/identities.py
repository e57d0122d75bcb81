"""Tables on unnamed landmarks: scores and decisions."""

from collections.abc import Sequence

from teamslam.central.desk.evaluation.association import AssociationResult, Pairs
from teamslam.central.desk.report.tables import Sheet, format_figure
from teamslam.team.wire import messages as m

SCORE_HEADINGS = ("pairs of detections", "precision", "recall", "F1", "wrong\ndetections")
DECISION_HEADINGS = (
    "decision", "at [s]", "pairs", "LLR", "absent", "rival's\npairs", "rival's\nevidence", "share",
    "sd [m]", "why",
)  # fmt: skip
DECISION_NOTE = (
    "LLR: log-likelihood ratio of the pairs; absent: landmarks that one side has where the other "
    "looked and has none, which speak against; share: of the landmarks there, matched ones. What "
    "waits failed the test that is named; what is undone was taken back by a later one."
)
LISTED = 200
"""Most decisions in the table; report.json has all."""


def score_sheet(found: AssociationResult) -> Sheet:
    """Scores inside windows and over all."""
    rows = [_row("inside windows", found.inside), _row("over all", found.pairs)]
    return Sheet(SCORE_HEADINGS, rows, _score_note(found))


def _row(name: str, pairs: Pairs) -> tuple[str, ...]:
    return (
        name,
        format_figure(pairs.precision, ".5f", ""),
        format_figure(pairs.recall, ".4f", ""),
        format_figure(pairs.f1, ".4f", ""),
        format_figure(pairs.wrong_percent, ".3f", " %"),
    )


def _score_note(found: AssociationResult) -> str:
    return (
        f"{found.landmarks} landmarks without names in all submaps, with those that the final map "
        "leaves out, that were given up, and that are of robots that are not joined; "
        f"{found.duplicates} of them are duplicates, "
        f"{found.duplicates_confirmed} among those of two submaps or more; pairs of robots that "
        f"share landmarks: {found.merges_right} rightly, {found.merges_wrong} wrongly; "
        f"{found.merges_refused} attempts wait. Scored by labels that no node receives."
    )


def decision_sheet(decisions: Sequence[m.AssociationDecision]) -> Sheet:
    """One row per closure and merge: accepted and undone ones, newest first, then pending ones."""
    made = [each for each in decisions if each.kind != "waits"]
    waits = [each for each in decisions if each.kind == "waits"]
    rows = [
        (
            f"{each.kind}: {each.about}",
            f"{each.stamp_ns * 1e-9:.1f}",
            str(each.pairs),
            f"{each.llr:.0f}",
            str(each.absent),
            str(each.rival_pairs),
            f"{each.rival_llr:.0f}",
            f"{each.share:.2f}",
            f"{each.sd:.2f}",
            each.why,
        )
        for each in [*reversed(made), *waits][:LISTED]
    ]
    return Sheet(DECISION_HEADINGS, rows, DECISION_NOTE)
