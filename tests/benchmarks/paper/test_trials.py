"""The lists of trials, trainings and stages of both experiments."""

import dataclasses

from benchmarks.paper.engine import Settings
from benchmarks.paper.trials import stages, trainings, trials
from tests.benchmarks.paper.made_up import TINY


def test_three_twins_and_three_seeds():
    found = trials("open", Settings())
    assert len(found) == len(set(found)) == 3 * 3 * (3 + 6) + 3 * (7 + 1)
    assert sum(trial.kind == "gradient" for trial in found) == 3 * 7
    beside = trials("open", dataclasses.replace(Settings(), beside=("quick", "payload")))
    assert len(beside) == len(set(beside)) == len(found) + 2 * 9 * 7
    found = trials("confined", Settings())
    assert len(found) == len(set(found)) == 9 * 9 + 9
    learned = trainings(Settings())
    assert len(learned) == len(set(learned)) == 7 * 9


def test_stages_leave_every_trial_s_result_and_come_after_what_they_need():
    settings = dataclasses.replace(TINY, beside=("quick",))
    for experiment in ("open", "confined"):
        groups = stages(experiment, settings)
        at = {path: k for k, group in enumerate(groups) for stage in group for path in stage.results}
        names = [stage.name for group in groups for stage in group]
        assert len(names) == len(set(names)) and len(at) == sum(len(s.results) for g in groups for s in g)
        for trial in trials(experiment, settings):
            run = f"{trial.kind}-twin{trial.twin}-seed0"
            with_s2r, nominal = f"twin{trial.twin}-seed0", "nominal-seed0"
            policies = {"with": [with_s2r], "gradient": [with_s2r], "specified": [nominal]}
            policies["without"] = [with_s2r, nominal]
            for folder in policies.get(trial.kind, [run]):
                assert at[f"{folder}/policy.npz"] < at[trial.result]
            own = f"twin{trial.twin}-seed0" if experiment == "open" else f"quick-twin{trial.twin}-seed0"
            assert at[f"twin{trial.twin}/calibration"] < at[f"{own}/policy.npz"]
        if experiment == "confined":
            for twin in TINY.twins:
                learned = {
                    kind: at[f"{kind}-twin{twin}-seed0/evaluation.json"] for kind in ("pipe", "narrow")
                }
                assert at[f"twin{twin}/demos-pipe300.npz"] < learned["pipe"] < learned["narrow"]
                circle = at[f"circle-twin{twin}-seed0/evaluation.json"]
                assert at[f"twin{twin}/demos-circle16.npz"] < circle
                assert at[f"quick-twin{twin}-seed0/evaluation.json"] < circle
