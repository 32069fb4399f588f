"""The paper's recipe as printed: its cases and its figures on made-up courses; a tiny run."""

import json

import pytest

from benchmarks.__main__ import main
from benchmarks.accuracy.printed import curves, final_figures
from benchmarks.harness import common
from train.presets import IMITATION_PRESETS


def test_the_paper_s_recipe_is_as_printed():
    circle, pipe = (IMITATION_PRESETS[name].learner for name in ("paper-circle", "paper-pipe"))
    for learner in (circle, pipe):
        assert (learner.n_arms, learner.n_updates_per_vector_step, learner.batch_size) == (14, 1, 256)
        assert (learner.gamma, learner.learning_rate, learner.tau) == (0.99, 3e-4, 0.005)
        assert (learner.gail.gradient_penalty, learner.gail.penalty_on) == (20.0, "probability")
        assert learner.hindsight.near_share == 0.0 == learner.expert_share
        assert not learner.hindsight.exchange_actions and learner.expert_start == "shown"
        assert learner.stages[1].kept == 0.2 and learner.stages[0].every == 2
    ends = [circle.n_env_steps(epochs) for epochs in (circle.stage_epochs[1], circle.n_epochs)]
    assert ends == pytest.approx([1e5, 3e5], rel=0.01)
    assert (pipe.total_env_steps, pipe.rebalance_env_steps) == (1_000_000, 100_000)


def test_figures_are_over_the_seeds_of_a_case():
    def course(*success):
        """Return a training's epochs, of which all but the first are evaluated."""
        rows = [{"env_steps": 100 * k, "updates": 10 * k, "evaluation/success_share": x} for k, x in success]
        return [{"env_steps": 100, "updates": 10}, *rows]

    metrics = {"circle-learned": [course((3, 0.0), (6, 0.5)), course((3, 0.25), (6, 1.0))]}
    steps = {"case": "circle-learned", "env_steps": 600, "updates": 60, "runs": 2}
    assert final_figures(metrics) == [steps | {"success_share": "0.75 ± 0.25 (0.5 to 1)"}]
    percent = [[0.0, 50.0], [25.0, 100.0]]
    assert curves(metrics) == [
        {"case": "circle-learned", "env_steps": [300, 600], "success_percent": percent}
    ]


@pytest.mark.slow
def test_smoke(tmp_path, monkeypatch):
    options = ["--cases", "circle-learned", "--seeds", "0", "--env-steps", "8000", "--out", str(tmp_path)]
    monkeypatch.setattr(common, "RESULTS", tmp_path / "results")
    assert main(["printed", *options]) == 0
    (case,) = json.loads((tmp_path / "results/printed.json").read_text("utf-8"))["figures"]["cases"]
    assert case["case"] == "circle-learned" and case["env_steps"] >= 8000
