"""The process of sections: against the textbook's formula, on planted sections, and its levers on an arm."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calib.fit import section_process
from calib.fit.section_process import LENGTHS, NOISES, Sections, fit_process, sections
from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.sensing.pose import frame_from_pose, pose_from_frame
from mjx_softarm.sensing.s2r import apply_correction

LEVER_MM = 100.0
SPEC = ArmSpec.default()
PARAMS = ArmParams.from_spec(SPEC)


@pytest.fixture(autouse=True)
def few_rows_choose(monkeypatch):
    """Choose length and noise by fewer rows."""
    monkeypatch.setattr(section_process, "MAX_GRID_ROWS", 60)


@jax.jit
def frames_and_sections(q):
    frames = chain_kinematics(PARAMS)(q)
    return frames, sections(frames, PARAMS, jnp.full(SPEC.n_chambers, 0.2))


def drawn(n, seed, s=2):
    """Sections in random states, whose middles are random frames under the tip."""
    rng = np.random.default_rng(seed)
    effect = np.zeros((n, s, 6, 6))
    turn = np.linalg.qr(rng.normal(size=(n, s, 3, 3)))[0]
    effect[..., :3, :3] = effect[..., 3:, 3:] = turn
    effect[..., :3, 3:] = rng.normal(size=(n, s, 3, 3))
    return Sections(rng.uniform(-1.0, 1.0, (n, s, 9)), effect, np.full(n, LEVER_MM))


def planted(at):
    """Corrections of which each section makes a part that depends on its own state."""
    u = at.state
    twist = np.stack([np.sin(2.0 * u[..., 0]), u[..., 1] * u[..., 2], u[..., 3] ** 2], axis=-1)
    own = np.concatenate([3.0 * twist, 1.0 + twist[..., ::-1]], axis=-1)
    y = np.einsum("nsij,nsj->ni", at.effect, own)
    return y / np.array([1.0, 1.0, 1.0, LEVER_MM, LEVER_MM, LEVER_MM])


def test_sections_are_learned_from_few_tips():
    """The states have 18 numbers, so 300 rows are thin; each section's nine are filled better."""
    rows, unseen = drawn(300, 0), drawn(100, 1)
    found = fit_process(rows, planted(rows))(unseen)
    spread = np.std(planted(unseen), axis=0)
    assert np.all(np.std(found - planted(unseen), axis=0) < 0.2 * spread)


def test_noise_is_told_from_the_correction():
    rows = drawn(300, 0)
    noise = np.random.default_rng(2).normal(size=(300, 6)) * [1.0, 1.0, 1.0, 0.01, 0.01, 0.01]
    found = fit_process(rows, planted(rows) + noise)(rows)
    assert np.all(np.std(found - planted(rows), axis=0) < 0.9 * np.std(noise, axis=0))


def test_the_mean_is_the_textbook_s():
    rows, unseen = drawn(20, 0), drawn(5, 1)
    y, levels = planted(rows), np.array([1.0, 1.0, 1.0, LEVER_MM, LEVER_MM, LEVER_MM])
    predicted = fit_process(rows, y)(unseen)

    def covariance(a, b, length):
        blocks = np.zeros((len(a.state), 6, len(b.state), 6))
        for i, j in np.ndindex(len(a.state), len(b.state)):
            for s in range(2):
                square = np.sum((a.state[i, s] - b.state[j, s]) ** 2)
                likeness = 1.0 + np.exp(-square / (2.0 * length**2))
                blocks[i, :, j] += likeness * a.effect[i, s] @ b.effect[j, s].T
        return blocks.reshape(6 * len(a.state), -1)

    means = [
        covariance(unseen, rows, length)
        @ np.linalg.solve(covariance(rows, rows, length) + s * np.eye(120), (y * levels).ravel())
        for length in LENGTHS
        for s in NOISES
    ]
    off = [np.abs(mean.reshape(-1, 6) / levels - predicted).max() for mean in means]
    assert min(off) < 1e-6


def test_the_effect_is_what_the_tip_does_when_a_section_shifts_and_turns():
    """All below the middle of a section moves with it as a rigid body."""
    spread = np.tile([0.01, 0.1, 0.1], SPEC.n_links)
    q = np.float32(spread * np.random.default_rng(0).normal(size=3 * SPEC.n_links))
    frames, found = jax.device_get(frames_and_sections(q))
    own = 0.2 * np.array([1.0, -2.0, 0.5, 0.4, 0.3, -0.2])  # [mm], Gibbs vector * lever [mm]
    lever_mm, middle = float(found.lever_mm), SPEC.structure.links_per_section // 2
    np.testing.assert_allclose(lever_mm, 500.0 * SPEC.geometry.section_length_m)
    pose = np.asarray(pose_from_frame(frames.tip_position, frames.tip_rotation), float)
    for s in range(SPEC.structure.n_sections):
        plate = s * SPEC.structure.links_per_section + middle
        centre_m, axes = (np.asarray(x[plate], float) for x in (frames.plate_position, frames.plate_rotation))
        shift = np.concatenate([axes @ own[:3], axes @ own[3:] / lever_mm])
        about = pose.copy()
        about[:3] -= 1e3 * centre_m  # turn about the middle
        turned = pose_from_frame(*_turned(about, shift[3:]))
        expected_mm = turned[:3] + 1e3 * centre_m + shift[:3]
        change = np.asarray(found.effect[s]) @ own
        np.testing.assert_allclose(change[:3], expected_mm - pose[:3], atol=2e-3)
        np.testing.assert_allclose(change[3:] / lever_mm, shift[3:], atol=1e-6)


def _turned(pose, gibbs):
    position_m, rotation = frame_from_pose(pose)
    turned = apply_correction((np.zeros(3), np.eye(3)), np.concatenate([np.zeros(3), gibbs]))[1]
    turned = turned / np.cbrt(np.linalg.det(turned))
    return turned @ position_m, turned @ rotation
