from teamslam.central.desk.evaluation.events import EventDetector
from teamslam.central.desk.view.page_frames import sets_of
from teamslam.team.wire import messages as m
from tests import build
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
    again = build.fused_map(**(fields | {"decisions": (decision, undone)}))
    assert [
        each.kind for each in detector.take(again, 0) if each.kind in ("closure", "undone")
    ] == ["undone"]
    assert not [each for each in detector.take(again, 0) if each.kind in ("closure", "undone")]
