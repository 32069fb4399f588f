"""The compiled MuJoCo model has the paper's figures; its pictures show it."""

import functools
import itertools
import os

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.drawing import render
from mjx_softarm.mechanics.mjcf import build_model

LOW_KPA, FREE_KPA, HIGH_KPA = -40.0, 0.0, 20.0


@pytest.fixture(scope="module")
def model(spec):
    return build_model(spec)


@functools.cache
def section_at_rest(*pressure_kpa):
    """Length [mm] and bending angle [deg] of one unloaded section, stepped in time until at rest."""
    model = build_model(ArmSpec.default().replace(structure={"n_sections": 1}))
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.ctrl[:] = pressure_kpa
    for _ in range(10_000):
        mujoco.mj_step(model, data)
        if max(np.abs(data.qvel).max(), np.abs(data.qacc).max()) < 1e-7:
            break
    else:
        pytest.fail(f"a section at {pressure_kpa} kPa did not come to rest")
    tip = data.site("tip")
    angle = Rotation.from_matrix(tip.xmat.reshape(3, 3)).magnitude()
    return 1e3 * np.linalg.norm(tip.xpos), np.rad2deg(angle)


@pytest.mark.parametrize("pressure_kpa, length_mm", [(LOW_KPA, 105.0), (FREE_KPA, 200.0), (HIGH_KPA, 235.0)])
def test_one_section_has_the_paper_s_lengths(pressure_kpa, length_mm):
    length, angle = section_at_rest(pressure_kpa, pressure_kpa, pressure_kpa)
    assert length == pytest.approx(length_mm, abs=0.5)
    assert angle < 1e-6


def test_one_section_bends_by_the_paper_s_95_deg_and_no_further():
    # The paper prints the angle beside the shortest and the longest section; it is taken as a section's too.
    levels = (LOW_KPA, FREE_KPA, HIGH_KPA)
    angle = {p: section_at_rest(*p)[1] for p in itertools.product(levels, repeat=3)}
    one_pushes, two_push = (HIGH_KPA, LOW_KPA, LOW_KPA), (LOW_KPA, HIGH_KPA, HIGH_KPA)
    assert max(angle, key=angle.get) in set(itertools.permutations(one_pushes))
    assert max(angle.values()) == pytest.approx(95.0, abs=5.0)
    assert angle[two_push] < angle[one_pushes]
    for pattern in (one_pushes, two_push):  # no direction is special but for the hinges' order
        turned = [angle[p] for p in set(itertools.permutations(pattern))]
        assert max(turned) - min(turned) < 1.2


def test_springs_and_pressure_limits(model):
    springs = [model.tendon(f"spring{k}").id for k in range(9)]
    np.testing.assert_array_equal(model.tendon_stiffness[springs], 54.0)  # 0.054 N/mm
    np.testing.assert_array_equal(model.tendon_damping[springs], 30.0)  # 0.03 N s/mm
    np.testing.assert_array_equal(model.tendon_lengthspring[springs], 0.2)
    np.testing.assert_array_equal(model.actuator_ctrlrange, [[LOW_KPA, HIGH_KPA]] * 9)
    assert model.actuator_ctrllimited.all()


def test_the_free_arm_hangs_straight_with_its_chambers_around_it(spec, model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.site("tip").xpos, [0.0, 0.0, -0.6], atol=1e-12)
    np.testing.assert_allclose(data.ten_length, 0.2, atol=1e-12)
    radii_m = {"chamber": spec.geometry.chamber_radius_m, "spring": spec.geometry.spring_radius_m}
    for plate, section in ((0, 0), (4, 0), (4, 1), (12, 2)):
        for k, angle in enumerate(
            np.deg2rad([90.0, 210.0, 330.0])
        ):  # chamber 0 at +y, then counter-clockwise
            for kind, radius in radii_m.items():
                hole = data.site(f"{kind}{3 * section + k}_plate{plate}").xpos
                expected = [radius * np.cos(angle), radius * np.sin(angle), -0.05 * plate]
                np.testing.assert_allclose(hole, expected, atol=1e-9)


def test_stiffness_and_damping_are_linear_since_mjx_uses_no_higher_terms(model):
    for field in ("jnt_stiffnesspoly", "tendon_stiffnesspoly", "dof_dampingpoly", "tendon_dampingpoly"):
        assert not getattr(model, field).any(), field


@pytest.fixture(scope="module")
def renderer(model):
    try:
        opened = render.Renderer(model, 150, 200)
    except render.RenderError as error:
        pytest.skip(f"no OpenGL here: {error}")
    with opened:
        yield opened


def test_a_picture_of_nothing_is_refused(renderer):
    with pytest.raises(ValueError, match=r"^q: got"):
        renderer.draw(np.full(36, np.nan))


@pytest.mark.skipif(os.uname().sysname != "Linux", reason="EGL and OSMesa are Linux's")
def test_without_opengl_the_message_says_what_was_tried_and_what_to_do(model, monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(render, "_HEADLESS", ("no_such_library", "nor_this"))
    render._working_library.cache_clear()
    with pytest.raises(render.RenderError) as caught:
        render.Renderer(model)
    render._working_library.cache_clear()
    message = str(caught.value)
    assert "no_such_library: " in message and "nor_this: " in message and "MUJOCO_GL=egl" in message
    assert "\n" not in message
