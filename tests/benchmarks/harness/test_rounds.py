"""Programs that take turns, those that fail or say nothing among them."""

import os

from benchmarks.harness import rounds
from benchmarks.harness.rounds import Worker, take_turns, working

PROGRAM = """
import os, sys
from benchmarks.harness.rounds import serve

def prepare():
    print("a library's chatter")
    os.system("echo chatter of another process")
    count = iter(range(100))
    cores = len(os.sched_getaffinity(0))
    return {"cores": cores}, lambda: {"n": next(count), "wanted": 1 / float(sys.argv[1])}

serve(prepare)
"""


def program(tmp_path, monkeypatch, argument, **kwargs):
    (tmp_path / "taking_turns.py").write_text(PROGRAM)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return Worker(f"turns of {argument}", ["taking_turns", argument], **kwargs)


def test_programs_take_turns_whatever_they_print(tmp_path, monkeypatch):
    first, second = (program(tmp_path, monkeypatch, x) for x in ("1", "2"))
    told, failed = take_turns([first, second], 2)
    assert failed == {} and told == {
        "turns of 1": [{"n": 0, "wanted": 1.0}, {"n": 1, "wanted": 1.0}],
        "turns of 2": [{"n": 0, "wanted": 0.5}, {"n": 1, "wanted": 0.5}],
    }


def test_a_program_keeps_to_its_cores_and_we_keep_ours(tmp_path, monkeypatch):
    before = os.sched_getaffinity(0)
    worker = program(tmp_path, monkeypatch, "1", n_cores=1)
    with working(worker):
        assert worker.facts == {"cores": 1}
    assert os.sched_getaffinity(0) == before


def test_a_program_that_fails_loses_no_other_s_rounds(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.harness.rounds.ANSWER_S", 20.0)
    good, bad, none = (program(tmp_path, monkeypatch, x) for x in ("1", "0", "no number"))
    missing = Worker("missing", ["no_such_module"])
    told, failed = take_turns([bad, good, missing, none], 2)
    assert told == {"turns of 1": [{"n": 0, "wanted": 1.0}, {"n": 1, "wanted": 1.0}]}
    assert "ZeroDivisionError" in failed["turns of 0"] and "ValueError" in failed["turns of no number"]
    assert failed["missing"].endswith("No module named no_such_module")


def test_a_program_that_says_nothing_is_stopped(tmp_path, monkeypatch):
    (tmp_path / "silent.py").write_text("import time\ntime.sleep(600)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(rounds, "ANSWER_S", 0.5)
    told, failed = take_turns([Worker("silent", ["silent"])], 1)
    assert told == {}
    assert failed["silent"].startswith("silent: got status -9 after 0.5 s in silence")
