from teamslam.central.desk.evaluation.association import AssociationResult, Pairs
from teamslam.central.desk.evaluation.events import EventDetector
from teamslam.central.desk.report.tables import score_sheet
from teamslam.central.desk.view.landmark_sets import sets_of
from teamslam.team.wire import messages as m
from tests.support import examples

FUSED = next(each for each in examples() if isinstance(each, m.FusedMap))


def test_the_page_says_of_a_landmark_who_its_members_are_and_by_which_step():
    count, words = sets_of(FUSED)[2**31 + 7]
    assert count == 2
    assert words == [
        "alpha/1/0/4",
        "alpha/1/1/2: track, log-likelihood ratio 5.5, its best rival -2.0, sd 0.25 m",
    ]


def test_a_closure_is_an_event_once_and_so_is_that_it_is_undone():
    detector = EventDetector()
    first = [each for each in detector.take(FUSED, 0) if each.kind == "closure"]
    assert [each.text for each in first] == [
        "alpha (incarnation 1) and bravo (incarnation 0) merged by their maps: 12 landmarks, "
        "log-likelihood ratio 40 against 6, share 0.75, 0 absent"
    ]
    (decision,) = FUSED.decisions
    undone = m.AssociationDecision(
        **{
            name: getattr(decision, name)
            for name in m.AssociationDecision.__struct_fields__
            if name not in ("kind", "why")
        },
        kind="undone",
        why="share 0.41 < 0.5 after 3 ticks",
    )
    fields = {name: getattr(FUSED, name) for name in m.FusedMap.__struct_fields__}
    again = m.FusedMap(**(fields | {"decisions": (decision, undone)}))
    assert [
        each.kind for each in detector.take(again, 0) if each.kind in ("closure", "undone")
    ] == ["undone"]
    assert not [each for each in detector.take(again, 0) if each.kind in ("closure", "undone")]


def test_the_report_scores_pairs_inside_windows_and_over_all():
    def pairs(missed: int) -> Pairs:
        return Pairs(right=30, wrong=10, missed=missed, wrong_detections=1, detections=50)

    found = AssociationResult(
        pairs=pairs(30),
        inside=pairs(0),
        label_of={},
        landmarks=9,
        duplicates=2,
        duplicates_confirmed=1,
        duplicates_shown=0,
        merges_right=4,
        merges_wrong=0,
        merges_refused=3,
        left_out=0,
        clutter_in_map=0,
    )
    assert score_sheet(found).rows == [
        ("inside windows", "0.75000", "1.0000", "0.8571", "2.000 %"),
        ("over all", "0.75000", "0.5000", "0.6000", "2.000 %"),
    ]
    assert "4 rightly, 0 wrongly; 3 attempts wait" in score_sheet(found).note
