"""Rest under the sensor-space law for any references: complementary, or said not to be found."""

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import RESIDUAL_TOLERANCE, TRACKING_TOLERANCE_M, settle
from tests.properties import few

SPEC = ArmSpec.default()
PARAMS = ArmParams.from_spec(SPEC)
LENGTHS_M = npst.arrays(
    np.float32,
    SPEC.n_chambers,
    elements=st.floats(0.0859375, 0.2734375, width=32),  # within what may be commanded
)
_settle = jax.jit(lambda reference_m: settle(chain_kinematics(PARAMS), PARAMS, reference_m))


@few
@given(reference_m=LENGTHS_M)
def test_each_spring_is_on_its_reference_or_its_chamber_at_the_limit_that_stops_it(reference_m):
    found = jax.device_get(_settle(reference_m))
    low_kpa, high_kpa = SPEC.chambers.pressure_min_kpa, SPEC.chambers.pressure_max_kpa
    error_m, kpa = reference_m - found.spring_m, found.pressure_kpa
    assert found.residual < RESIDUAL_TOLERANCE
    assert np.all((kpa >= low_kpa) & (kpa <= high_kpa))
    assert np.all((error_m < TRACKING_TOLERANCE_M) | (kpa == high_kpa))  # too short: it can push no further
    assert np.all((error_m > -TRACKING_TOLERANCE_M) | (kpa == low_kpa))  # too long: it can pull no further
