"""Meshes of the picture, and the parts of other arms."""

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs viser: pip install -e '.[view]'")
from mjx_softarm.mechanics.body import COILS, FOLDS, SPRING_WIDTH_M
from mjx_softarm.view.look import Limits, look_at
from mjx_softarm.view.stage import SECTION_COLOURS, Stage


def test_parts_of_other_arms_are_drawn(server, other_arm):
    """A bellows for each chamber in its section's colour, a coil for each spring, rings by section."""
    spring_m = other_arm.at_springs(other_arm.geometry.section_length_m)
    stage = Stage(server.scene, other_arm, Limits.of(other_arm))
    stage.show(look_at({"time_s": 0.0}, spring_m, other_arm))
    assert len(stage._folds.batched_positions) == other_arm.n_chambers * FOLDS
    assert len(stage._coils.batched_positions) == other_arm.n_springs * COILS
    of_sections = stage._folds.batched_colors.reshape(3, -1, 3)
    np.testing.assert_array_equal(
        of_sections, np.broadcast_to(np.array(SECTION_COLOURS)[:, None], of_sections.shape)
    )
    radius_m = np.add(other_arm.per_section(other_arm.geometry.spring_radius_m), SPRING_WIDTH_M)
    np.testing.assert_allclose(stage._rings.batched_scales.reshape(3, -1, 3)[:, 0, 0], radius_m, rtol=1e-6)
