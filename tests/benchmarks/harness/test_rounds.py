"""Programs that take turns, those that fail or say nothing among them."""

from benchmarks.harness import rounds
from benchmarks.harness.rounds import Worker, take_turns

PROGRAM = """
import os, sys, time
from benchmarks.harness.rounds import serve

def prepare():
    print("a library's chatter")
    os.system("echo chatter of another process")
    if sys.argv[1] == "silent":
        time.sleep(600)
    count = iter(range(100))
    return {}, lambda: {"n": next(count), "share": 1 / float(sys.argv[1])}

serve(prepare)
"""


def test_programs_take_turns_and_one_that_fails_loses_no_other_s_rounds(tmp_path, monkeypatch):
    (tmp_path / "taking_turns.py").write_text(PROGRAM)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(rounds, "ANSWER_S", 20.0)
    names = ("0", "1", "2")  # the first divides by zero in its first round
    workers = [Worker(name, ["taking_turns", name]) for name in names]
    answers, failed = take_turns([*workers, Worker("missing", ["no_such_module"])], 2)
    assert answers == {
        "1": [{"n": 0, "share": 1.0}, {"n": 1, "share": 1.0}],
        "2": [{"n": 0, "share": 0.5}, {"n": 1, "share": 0.5}],
    }
    assert failed["0"].endswith("ZeroDivisionError: float division by zero")
    assert failed["missing"].endswith("No module named no_such_module")
    monkeypatch.setattr(rounds, "ANSWER_S", 0.5)
    answers, failed = take_turns([Worker("silent", ["taking_turns", "silent"])], 1)
    assert answers == {} and failed["silent"].startswith("silent: got status -9 after 0.5 s in silence")
