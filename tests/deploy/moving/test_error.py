"""The correction of a moving goal."""

import numpy as np
import pytest

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.moving.error import WayError
from tests.linear_arm import DT_S, POLICY


@pytest.mark.parametrize("n_lead", [0, 1, 25])
def test_an_error_that_stays_beside_a_round_way_is_made_up_for(n_lead):
    """The tip is late, wide and high by constants in the axes of the way, less the correction of its goal."""
    way, corrected, per_tick, n_ago = WayError(), [], 2 * np.pi / 20.0 * DT_S, max(n_lead, 1)
    controller = Controller.of(POLICY)
    controller.__dict__["lead_s"] = n_lead * DT_S  # in place of the value that it would find

    def axes(k):
        at = k * per_tick
        outward = np.array([np.cos(at), np.sin(at), 0.0])
        return outward, np.array([-np.sin(at), np.cos(at), 0.0]), np.array([0.0, 0.0, 1.0])

    for k in range(1500):
        now, ahead = (np.append(80.0 * axes(tick)[0], np.zeros(3)) for tick in (k, k + n_lead))
        late = corrected[-n_ago] if len(corrected) >= n_ago else np.zeros(6)  # the correction is in force
        outward, along, up = axes(k)
        off_mm = 3.0 * outward - 4.0 * along + 2.0 * up
        way = way.after(ahead, now + np.append(off_mm, np.zeros(3)) + late, controller)
        corrected.append(way.correction)
    assert np.linalg.norm(off_mm + late[:3]) < 0.02 * np.linalg.norm(off_mm)
    assert not corrected[n_lead].any() and not way.correction[3:].any()
