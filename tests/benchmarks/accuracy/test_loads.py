"""Policies on the circle with payloads: means of runs, and a line for each policy."""

from benchmarks.accuracy import loads
from mjx_softarm.policy.file import SHIPPED


def test_means_and_the_largest_error_are_over_the_arms_of_a_kind(tmp_path, monkeypatch):
    asked = []

    def on_circle(policy, arm, points):
        asked.append((arm, points))
        mm = 1.0 + len(asked)
        return {**dict.fromkeys(loads.MEANS.values(), mm), "max_mm": 2.0 * mm}

    monkeypatch.setattr(loads, "on_circle", on_circle)
    monkeypatch.setattr(loads, "RESULTS", tmp_path)
    arms = ("twin:0", "twin:1", "twin:rod:0")
    found = loads.measure(tuple(f"mine={arm}={SHIPPED}" for arm in arms), loads=(0, 500), points=3)
    assert asked[:2] == [("twin:0", 3), ("twin:0:500g", 3)] and asked[-1] == ("twin:rod:0:500g", 3)
    assert (tmp_path / "loads.png").stat().st_size > 0
    means = {(row["on"], row["load [g]"]): row for row in found["means"]}
    assert [row["policies"] for row in means.values()] == [2, 2, 1, 1]
    assert means["twins", 500]["mean [mm]"] == 4.0  # of 3 and 5
    assert means["twins", 500]["largest [mm]"] == 10.0


def test_each_policy_has_a_line_on_each_kind_of_arm():
    row = {"load [g]": 0, "mean [mm]": 1.0, "largest [mm]": 2.0}
    rows = [row | {"policy": p, "on": on} for p in ("a", "b") for on in ("twins", "rods")]
    twins, rods = loads.loads_figure([*rows, rows[0] | {"load [g]": 500}]).axes
    assert [line.get_label() for line in twins.lines if not line.get_label().startswith("_")][:2] == [
        "a",
        "b",
    ]
    assert twins.get_title(loc="left") == "circle, twins" and rods.get_title(loc="left") == "circle, rods"
