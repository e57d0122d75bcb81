"""Two messages are compared field by field, within rounding where bits are not promised."""

import msgspec

from teamslam.central.desk.verification.differences import first_difference
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats
from tests import build
from tests.support import packed, spd


def prior(value: float) -> m.Prior:
    bias = m.BiasEstimate(robot="r1", incarnation=0, bias="bearing", value=value, sigma=0.1)
    return build.prior(
        incarnation=0,
        ids=b"",
        mean=from_floats([0.0] * 3),
        covariance=packed(spd(3)),
        biases=(bias,),
    )


def test_a_bias_that_rounding_has_moved_differs_only_where_bits_are_promised() -> None:
    there, here = prior(0.25), prior(0.25 * (1.0 + 1e-15))
    assert first_difference(there, here, exact=False) is None
    exact = first_difference(there, here, exact=True)
    assert exact is not None
    assert exact.field == "biases"
    assert first_difference(there, prior(0.26), exact=False) is not None
    fewer = msgspec.structs.replace(there, biases=())
    assert first_difference(there, fewer, exact=False) is not None
