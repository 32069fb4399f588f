"""The learner's benchmark: rounds that take turns, contestants left out, ratios; with made-up programs."""

import sys
from types import SimpleNamespace

import pytest

from benchmarks.speed import learner
from benchmarks.speed.learner import BATCH_SIZES, CONTESTANTS, updates_per_round
from benchmarks.speed.learner_contestants import choose_threads

ROWS_PER_S = {"ours": 64_000.0, "sb3-contrib": 16_000.0, "sbx": 32_000.0, "brax": 128_000.0}


@pytest.fixture
def asked(monkeypatch):
    """Programs of known rates that take turns: a list of (name, batch size, updates), and who fails."""
    asked = SimpleNamespace(programs=[], fails=None)

    def take_turns(workers, n_rounds):
        sizes = {worker.name: [int(x) for x in worker._command[-2:]] for worker in workers}
        asked.programs += [(name, *size) for name, size in sizes.items()]
        failed = {name: f"{name}: no memory" for name in sizes if (name, sizes[name][0]) == asked.fails}
        rates = {name: ROWS_PER_S[name] / size for name, (size, _) in sizes.items() if name not in failed}
        return {name: [{"updates_per_s": x}] * n_rounds for name, x in rates.items()}, failed

    monkeypatch.setattr(learner, "take_turns", take_turns)
    monkeypatch.setattr(learner, "peer_python", lambda name: name)
    return asked


def test_contestants_take_turns_at_each_size_with_ratios_beside(asked):
    figures = learner.measure()
    assert [program[:2] for program in asked.programs] == [
        (n, size) for size in BATCH_SIZES for n in CONTESTANTS
    ]
    rates = {"ours": 250.0, "sb3-contrib TQC": 62.5, "SBX TQC": 125.0, "brax SAC": 500.0}
    ratios = {"ours / sb3-contrib": 4.0, "ours / sbx": 2.0, "ours / brax": 0.5}
    assert figures["updates_per_s"][0] == {"batch": 256, **rates, **ratios}
    assert [row["batch"] for row in figures["updates_per_s"]] == [256, 1024, 4096, 16_384, 32_768]
    assert figures["left_out"] == [] and figures["rounds"][0]["ours"] == [250.0] * learner.N_ROUNDS


def test_updates_per_round_keep_a_round_at_about_its_time(asked):
    learner.measure()
    for name, batch_size, n_updates in asked.programs:
        if batch_size > 256:  # the first is not known yet
            round_s = n_updates * batch_size / ROWS_PER_S[name]
            assert learner.ROUND_S / 1.5 < round_s < learner.ROUND_S * 1.5 or n_updates == 1
    assert updates_per_round(1e-3) == 2048 and updates_per_round(60.0) == 1


def test_a_contestant_that_would_be_too_slow_is_left_out_and_the_table_says_so(asked, monkeypatch):
    monkeypatch.setattr(learner, "SLOW_S", 1.0)  # sb3-contrib needs 1.02 s at 16,384
    figures = learner.measure()
    assert "sb3-contrib TQC" not in figures["updates_per_s"][3]
    assert figures["updates_per_s"][2]["sb3-contrib TQC"] == 3.91
    left_out = {row["contestant"]: row["why"] for row in figures["left_out"]}
    assert left_out["sb3-contrib TQC"] == "from batch 16,384 on: an update is expected to take 1 s"
    assert left_out["SBX TQC"].startswith("from batch 32,768 on")
    assert "ours" in figures["updates_per_s"][3] and "brax SAC" in figures["updates_per_s"][4]


@pytest.mark.parametrize("name", ["sbx", "ours"])
def test_a_contestant_that_fails_is_left_out_from_there_and_the_others_go_on(asked, name):
    asked.fails = (name, 1024)
    figures = learner.measure()
    first, second, *later = figures["updates_per_s"]
    assert CONTESTANTS[name] in first and first["ours / sbx"] == 2.0
    assert all(CONTESTANTS[name] not in row and "ours / sbx" not in row for row in (second, *later))
    rates = {"ours": 62.5, "sb3-contrib TQC": 15.6, "SBX TQC": 31.2, "brax SAC": 125.0}
    del rates[CONTESTANTS[name]]
    assert second.items() >= rates.items()
    why = f"from batch 1,024 on: {name}: no memory"
    assert figures["left_out"] == [{"contestant": CONTESTANTS[name], "why": why}]


@pytest.mark.parametrize(
    "times, chosen",
    [
        ({4: [9.0, 1.0, 1.0, 1.0], 1: [3.0] * 4}, 4),
        ({4: [50.0] * 4, 1: [9.0, 60.0, 3.0, 70.0]}, 1),  # the best of three, after one that does not count
        ({4: [50.0] * 4, 1: [3.0, 60.0, 60.0, 60.0]}, 4),
    ],
)
def test_pytorch_gets_the_threads_it_trains_fastest_with(monkeypatch, times, chosen):
    threads, clock = [4], [0.0]
    torch = SimpleNamespace(
        get_num_threads=lambda: threads[0], set_num_threads=lambda n: threads.__setitem__(0, n)
    )
    monkeypatch.setitem(sys.modules, "torch", torch)
    monkeypatch.setattr("benchmarks.speed.learner_contestants.time.perf_counter", lambda: clock[0])
    left = {n: iter(own) for n, own in times.items()}
    choose_threads(lambda: clock.__setitem__(0, clock[0] + next(left[threads[0]])))
    assert threads == [chosen]
