"""The benchmark of engines in motion: errors of paths, and a row for each engine, failed ones too."""

import numpy as np
import pytest

from benchmarks.speed import motion
from mjx_softarm import ArmSpec
from mjx_softarm.mechanics.workspace import settle_many

SPEC = ArmSpec.default().replace(structure={"links_per_section": 2})
N_PERIODS = 5


@pytest.fixture(scope="module")
def told():
    """Facts of two arms whose second one is 3 mm beside C MuJoCo, after their start."""
    rng = np.random.default_rng(0)
    pressure_kpa = rng.uniform(-30.0, 15.0, (2, SPEC.n_chambers))
    q = settle_many(SPEC, np.float32(pressure_kpa)).q
    reference_m = rng.uniform(0.14, 0.2, (2, 2, SPEC.n_chambers))
    path_mm = [
        motion.true_path_mm(SPEC, *arm, np.repeat(asked, N_PERIODS, axis=0))
        for *arm, asked in zip(np.asarray(q, float), pressure_kpa, reference_m, strict=True)
    ]
    path_mm[1][1:] += [0.0, 0.0, 3.0]
    return {"q": q, "pressure_kpa": pressure_kpa, "reference_m": reference_m, "path_mm": path_mm}


def test_an_error_is_the_distance_from_c_mujoco(told):
    assert np.linalg.norm(np.diff(told["path_mm"][0], axis=0), axis=-1).sum() > 5.0  # it moves
    assert motion.path_error(2, told) == pytest.approx({"median_mm": 1.5, "p95_mm": 3.0, "max_mm": 3.0})


def test_each_engine_has_a_row(told, monkeypatch):
    def take_turns(workers, n_rounds):
        for worker in workers:
            worker.facts = {**told, "tracing_s": 1.0, "compiling_s": 2.0}
        rates = [{"env_steps_per_s": rate} for rate in (100.0, 300.0, 200.0)]
        return {worker.name: rates for worker in workers[:-1]}, {workers[-1].name: "no memory"}

    monkeypatch.setattr(motion, "take_turns", take_turns)
    monkeypatch.setattr(motion, "LINKS", (2,))
    rows = motion.measure()["engines"]
    assert [(row["engine"], row["step_ms"]) for row in rows] == [("chain", 20.0), ("mjx", 20.0), ("mjx", 2.0)]
    assert rows[0]["env_steps_per_s"] == 200 and rows[0]["p95_mm"] == pytest.approx(3.0)
    assert rows[-1]["failed"] == "no memory"
