"""Policies of rods by the poses of their calibration: the targets."""

from benchmarks.calibration.planning import CIRCLE_MM, RECORDINGS, targets


def rows(name, off_g, grid_mm, unknown):
    shared = {"rod": 0, "seed": 0, "recording": RECORDINGS[name], "unknown directions": unknown}
    circle = [
        shared
        | {"goals": "circle", "payload [g]": g, "mean [mm]": 1.4, "believed [mm]": 1.0}
        | {"told [g]": g - off_g, "interval of the mean holds it": off_g < 100}
        for g in CIRCLE_MM
    ]
    return [*circle, shared | {"goals": "grid", "payload [g]": 0, "largest [mm]": grid_mm}]


def test_planned_poses_are_judged_beside_random_ones_of_the_same_rods():
    found = {row["target"]: row["verdict"] for row in targets(rows("random", 120, 8.0, 4))}
    assert found.pop("500 random: 95 % of the intervals hold the payload") == "NOT MET"
    assert set(found.values()) == {"met"} and len(found) == 4

    both = targets(rows("random", 120, 8.0, 4) + rows("planned", 55, 7.0, 0))
    *_, payload, grid = both
    assert (payload["measured"], payload["verdict"]) == ("from 120 to 55 g", "met")
    assert (grid["measured"], grid["verdict"]) == ("from 8 to 7 mm", "NOT MET")
    other_rod = [row | {"rod": 1} for row in rows("planned", 55, 7.0, 0)]
    assert len(targets(rows("random", 120, 8.0, 4) + other_rod)) == len(both) - 2


def test_poses_with_a_known_weight_are_judged_by_the_payload():
    verdicts = [targets(rows("weighed", off_g, 8.0, 4))[-1]["verdict"] for off_g in (30, 40)]
    assert verdicts == ["met", "NOT MET"]
