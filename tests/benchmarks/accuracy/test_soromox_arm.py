"""The arm that SoRoMoX simulates: its fibres pull as a rod's, and it rests where a rod rests."""

import json
import subprocess

import jax
import numpy as np
import pytest

from benchmarks.accuracy.soromox_arm import fibre_energy
from benchmarks.harness.rounds import ROOT
from mjx_softarm.twin.rod_twin import RodTwin

PYTHON = ROOT / ".venv-soromox" / "bin" / "python"


def test_fibres_pull_as_those_of_a_rod():
    rod, rng = RodTwin(0)._rod, np.random.default_rng(0)
    (n_sections, n_chambers), parts = rod.parts.stiffness.shape, rod.parts
    pressure_kpa = rng.uniform(-40.0, 20.0, (n_sections, n_chambers))
    n_fibres = n_chambers + parts.spring_hole_m.shape[1]
    stretch = rng.uniform(0.7, 1.3, (n_sections, rod.per_section, n_fibres))
    full_m = parts.section_length_m[:, None, None]
    with jax.enable_x64(True):
        pulls = jax.grad(lambda x: fibre_energy(x, pressure_kpa, parts).sum())(stretch) / full_m
    expected, _ = rod._fibres((full_m * stretch).reshape(-1, n_fibres), pressure_kpa)
    np.testing.assert_allclose(np.asarray(pulls).reshape(expected.shape), expected, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON.exists(), reason="the environment of SoRoMoX is not made")
def test_it_rests_where_a_rod_of_the_same_parts_rests():
    """Half a millimetre with six pieces a section; both lose it with more pieces."""
    command = [PYTHON, "-m", "benchmarks.accuracy.soromox_arm", "1", "3"]
    output = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    apart_mm = json.loads(output)["apart_mm"]
    assert len(apart_mm) == 3 and max(apart_mm) < 0.6
