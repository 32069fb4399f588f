"""Rows and targets of the benchmark of start-up, on made-up seconds."""

from benchmarks.speed import start


def test_each_preset_starts_with_an_empty_and_with_a_filled_cache(monkeypatch):
    caches = []

    def started(preset, cache):
        caches.append(cache)
        return {"total_s": 3.0 if cache in caches[:-1] else 11.0}

    monkeypatch.setattr(start, "_start", started)
    figures = start.measure(("analytic", "quick", "payload"))
    assert [(row["preset"], row["cache"], row["total_s"]) for row in figures["starts"]] == [
        (preset, *state)
        for preset in ("analytic", "quick", "payload")
        for state in (("empty", 11.0), ("filled", 3.0))
    ]
    verdicts = [row["verdict"] for row in figures["targets"]]
    assert verdicts == ["NOT MET", "met", "met", "met", "met"]  # 10 s, 4 s; 12 s, 4 s; 4 s
