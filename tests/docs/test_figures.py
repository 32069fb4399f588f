"""Numbers in tables of README and the pages are those of the files under `docs/results`."""

import functools
import json
import re
from pathlib import Path
from statistics import fmean, median, pstdev

import pytest

ROOT = Path(__file__).parents[2]
ANGLES = "yaw_deg", "pitch_deg", "roll_deg"


@functools.cache
def stored(name):
    return json.loads((ROOT / f"docs/results/{name}.json").read_text("utf-8"))


def figures(name):
    return stored(name)["figures"]


def runs(arms, kind, variant):
    """The runs of a kind of policy; there is none of `quick` on rods."""
    rows = figures(f"paper-{arms}")["runs"]
    return [row for row in rows if (row["kind"], row["variant"]) == (kind, variant)]


def values(arms, kind, variant, name):
    return [row[name] for row in runs(arms, kind, variant)]


def mean(arms, kind, variant, name, digits=2):
    return f"{fmean(values(arms, kind, variant, name)):.{digits}f}"


def both(arms, kind, variant, name="translation_mm"):
    """Mean and standard deviation."""
    found = values(arms, kind, variant, name)
    return f"{fmean(found):.2f} ± {pstdev(found):.2f}"


def row(*cells):
    return f"| {' | '.join(cells)} |"


def circle_rows():
    """The table *Circle*; rods have no `quick`."""
    kinds = {
        "the specification": "specified",
        "calibrated springs": "without",
        "springs and chambers": "chambers",
        "all, with S2R": "with",
        "all, with S2R, `quick`": "quick",
        "all, with S2R, `payload`": "payload",
        "gradient descent, with S2R": "gradient",
    }
    for title, kind in kinds.items():
        cells = [title]
        for arms in ("open", "rod"):
            known = runs(arms, kind, "0 g")
            angles = "/".join(mean(arms, kind, "0 g", name) for name in ANGLES) if known else ""
            error = f"{both(arms, kind, '0 g')}, {mean(arms, kind, '0 g', 'rmse_mm')}" if known else ""
            cells += [error, angles]
        yield re.sub(r"  +", " ", row(*cells))


def load_rows():
    """The table *Payloads*."""
    kinds = {"`analytic`": "with", "`payload`": "payload", "`quick`, TQC alone": "quick"}
    for title, kind in (kinds | {"gradient descent": "gradient"}).items():
        cells = [title]
        for arms in ("open", "rod"):
            if not runs(arms, kind, "1000 g"):
                cells += [""] * 3
                continue
            rmse, most = mean(arms, kind, "1000 g", "rmse_mm"), max(values(arms, kind, "1000 g", "max_mm"))
            cells += [
                both(arms, kind, "500 g"),
                f"{both(arms, kind, '1000 g')}, {rmse}, {most:.1f}",
                "/".join(mean(arms, kind, f"{g} g", "load_off_g", 0) for g in (0, 500, 1000)),
            ]
        yield re.sub(r"  +", " ", row(*cells))


def lap_rows():
    """The table *Circle in time*."""
    for lap_s in (10, 20, 40):
        errors = {one["twin"]: one["way_mm"] for one in runs("open", "with", f"0 g in {lap_s} s")}
        yield row(f"{lap_s} s", *(f"{errors[arm]:.2f}" for arm in sorted(errors)))


def pipe_mm(kind, variant):
    """Mean errors in X/Y/Z in a pipe."""
    return "/".join(mean("confined", kind, variant, f"{axis}_mm") for axis in "xyz")


def pipe_rows():
    """The table *Pipes*."""
    for title, kind, variant in (
        ("300 mm, learned", "pipe", "as shown"),
        ("300 mm, learned, in motion", "pipe", "as shown in motion"),
        ("300 mm, hand-made", "hand-made", "as shown"),
        ("250 mm, hand-made", "narrow-hand-made", "as shown"),
        ("250 mm, reward learned in 300 mm", "narrow-learned", "as shown"),
        ("200 mm, learned", "narrowest", "as shown"),
        ("200 mm, hand-made", "narrowest-hand-made", "as shown"),
    ):
        done = [one["done"] == one["operations"] for one in runs("confined", kind, variant)]
        force = max(values("confined", kind, variant, "wall_max_n"))
        yield row(title, f"{sum(done)} of {len(done)}", pipe_mm(kind, variant), f"{force:.1f}")


def held_out_rows():
    """The table *Held-out goals*."""
    quick, analytic = figures("demo"), figures("analytic")
    for title, name, factor, digits in (
        ("median [mm]", "median_mm", 1, 2),
        ("95 % [mm]", "p95_mm", 1, 2),
        ("goals reached [%]", "reached_share", 100, 1),
        ("goals with a saturated chamber [%]", "saturated_share", 100, 1),
        ("uniform in volume: median [mm]", "even_median_mm", 1, 2),
        ("uniform in volume: 95 % [mm]", "even_p95_mm", 1, 2),
        ("uniform in volume: reached [%]", "even_reached_share", 100, 1),
        ("circle, mean [mm]", "circle_mean_mm", 1, 2),
    ):
        yield row(title, *(f"{factor * made[name]:.{digits}f}" for made in (quick, analytic)))


def main_rows():
    """The rows of the main table of *Results* whose files have all of their numbers."""
    circle = (mean(arms, "payload", "0 g", "rmse_mm") for arms in ("open", "rod"))
    here = "{} mm on twins, {} mm on rods".format(*circle)
    yield row("[Circle](#circle): RMSE of the tip", here, "11.59 mm, the paper's physical arm")
    heavy = (mean(arms, "payload", "1000 g", "rmse_mm") for arms in ("open", "rod"))
    most = max(max(values(arms, "payload", "1000 g", "max_mm")) for arms in ("open", "rod"))
    here = "{} mm on twins, {} mm on rods; largest error {:.1f} mm".format(*heavy, most)
    yield row("[With 1 kg](#payloads): RMSE", here, "largest 23.76 mm, the paper's arm")
    here = f"{mean('open', 'with', '0 g in 20 s', 'way_mm', 1)} mm on twins"
    yield row("[In 20 s](#circle-in-time), without stops: mean", here, "target 2.1 mm")
    shown = runs("confined", "pipe", "as shown")
    done = sum(one["done"] == one["operations"] for one in shown)
    here = f"{pipe_mm('pipe', 'as shown')} mm, {done} of {len(shown)} runs on twins"
    yield row("[Pipes](#pipes): error in X/Y/Z", here, "8.93/5.34/5.13 mm, the paper's arm")
    here = f"{figures('analytic')['circle_mean_mm']:.2f} mm"
    yield row("[In simulation](#held-out-goals): circle, mean", here, "RMSE 3.89 mm, the paper")
    here = f"{env_steps('mjx')} in MJX, {env_steps('chain')} in closed form"
    yield row("[Env steps/s](speed.md#env-steps), two CPU cores", here, "the paper at most 467")
    shares = [100 * one["circle, mean [mm]"] / one["length [mm]"] for one in figures("arms")["arms"]]
    *kinds, soromox = shares
    here = f"{min(kinds):.2f} to {max(kinds):.2f} % of the arm's length"
    yield row("[Kinds of arms](trust.md#kinds-of-arms): circle", here, "target 0.5 %")
    title = "[An arm in SoRoMoX](trust.md#kinds-of-arms), an independent library: circle"
    yield row(title, f"{soromox:.2f} % of its length", "target 0.5 %")
    sixty = [one["circle, mean [mm]"] for one in figures("arms-minutes")["arms"] if one["poses"] == 60]
    title = "[Ten minutes recorded](trust.md#minutes-of-recording), not 500 poses: circle"
    yield row(title, f"at most {max(sixty):.2f} mm", "target 1.5 mm")
    quick, sbx, sb3 = (f"{median(race(name, 'to_5_mm')):.0f} s" for name in RACED)
    here = f"TQC (`quick`) {quick}, `analytic` {max(race('ours-analytic', 'to_5_mm')):.0f} s"
    yield row("[Learning](speed.md#time-to-learn) to 5 mm", here, f"SBX {sbx}, sb3-contrib {sb3}")
    mjx, chain = (
        max(
            one["env_steps_per_s"]
            for one in figures("gpu")["env_steps"]
            if (one["engine"], one["mode"]) == (engine, "quasistatic")
        )
        / 1e6
        for engine in ("mjx", "chain")
    )
    here = f"{mjx:.1f} million in MJX, {chain:.1f} million in closed form"
    yield f"| [On a GPU](speed.md#on-a-gpu): env steps/s | {here} | |"


RACED = {
    "ours-quick": "`quick`",
    "sbx-hindsight": "SBX, `quick`'s settings, own hindsight",
    "sb3-contrib-hindsight": "sb3-contrib, in the same way",
}


def race(contestant, name):
    """A contestant's numbers, without those of seeds that did not come so far."""
    rows = [one[name] for one in figures("race")["wall_s"] if one["contestant"] == contestant]
    return [x for x in rows if not isinstance(x, str)]


def race_rows():
    """The table *Time to learn*; the gradient learner is at 1.5 mm by its first evaluation."""
    for name, title in RACED.items():
        cells = [f"{median(race(name, 'start_up_s')):.0f}"]
        for level in ("to_5_mm", "to_3_mm", "to_2_mm"):
            times = race(name, level)
            cells.append(f"{median(times):.0f} ({min(times):.0f} to {max(times):.0f})")
        once = race(name, "to_1_mm")
        cells.append(f"{once[0]:.0f}, one seed" if once else "")
        yield re.sub("  +", " ", row(title, *cells, f"{median(race(name, 'best_mm')):.2f}"))
    times, best = race("ours-analytic", "to_1_mm"), race("ours-analytic", "best_mm")
    first = f"within {max(race('ours-analytic', 'to_2_mm')):.0f}"
    once = f"{median(times):.0f} ({min(times):.0f} to {max(times):.0f})"
    start = f"{median(race('ours-analytic', 'start_up_s')):.0f}"
    yield row("`analytic`", start, first, first, first, once, f"{median(best):.2f}")


def env_steps(engine, mode="quasistatic", n_arms=1024):
    [found] = [
        one["env_steps_per_s"]
        for one in stored("throughput")["rows"]
        if (one["engine"], one["mode"], one["arms"]) == (engine, mode, n_arms)
    ]
    return f"{found:,}"


def step_rows():
    """The table *Env steps*."""
    for n in (64, 1024, 8192):
        cells = (("chain", "quasistatic"), ("mjx", "quasistatic"), ("mjx", "dynamic"))
        yield row(f"{n:,}", *(env_steps(*cell, n) for cell in cells))


def gpu_rows():
    """The table *On a GPU*. In its file our step in motion is called chain, and `mjx.step` mjx."""
    points = figures("gpu")["env_steps"]
    rates = {(one["engine"], one["mode"], one["arms"]): one.get("env_steps_per_s") for one in points}
    cells = ("chain", "quasistatic"), ("mjx", "quasistatic"), ("chain", "dynamic"), ("mjx", "dynamic")
    for n in (1024, 8192):
        yield row(f"{n:,}", *(f"{rates[*cell, n]:,}" for cell in cells))
    chain, moving = (rates[*cells[k], 65_536] for k in (0, 2))
    yield f"| 65,536 | {chain:,} | | {moving:,} | |"


def test_solves_per_second_are_those_of_the_file():
    rates = {
        (one["links_per_section"], one["method"]): one.get("solves_per_s")
        for one in figures("settle")["over_links"]
    }
    page = (ROOT / "docs/settling.md").read_text("utf-8").splitlines()
    for links in (2, 4):
        cells = (f"{rates[links, method]:,.0f}" for method in ("chain", "mjx", "stepping"))
        assert row(f"{links}", *cells) in page


def arm_rows():
    """The table *Kinds of arms*."""
    made_of = {one["arm"]: one for one in figures("arms")["arms"]}
    for title, name in (
        ("the paper's, 600 mm", "paper"),
        ("`sopra`, 250 mm", "sopra"),
        ("`stiff-flop`, 165 mm", "stiff-flop"),
        ("`four-chamber`, 300 mm", "four-chamber"),
        ("the paper's at a tenth of its mass, upright", "upright"),
        ("the paper's, in SoRoMoX", "soromox"),
    ):
        made = made_of[name]
        error, most, turn = (made[f"circle, {what}"] for what in ("mean [mm]", "largest [mm]", "mean [deg]"))
        digits = 2 if error < 1 else 1
        goals = f"{made['grid, measured']} of {made['grid, goals']}" + " goals" * (name == "paper")
        circle = f"{error:.{digits}f}; {most:.{digits}f}"
        share = f"{100 * error / made['length [mm]']:.2f} %"
        yield row(title, circle, share, f"{turn:.1f}", f"{made['grid, mean [mm]']:.1f} at {goals}")


def minutes_phrases():
    """Sentences of *Minutes of recording*."""
    made = figures("arms-minutes")["arms"]
    for n_poses, begin in (
        (60, "Six to ten minutes brought"),
        (150, "ten to twenty-six"),
        (500, "poses brought"),
    ):
        rows = [one for one in made if one["poses"] == n_poses]
        assert min(one["recording [min]"] for one in rows) > 5.9 and len(rows) == 6
        low, high = (f"{end(one['circle, mean [mm]'] for one in rows):.2f}" for end in (min, max))
        yield f"{begin} {low} to {high}"


def calibration_phrases():
    """Sentences of *Calibration*, of a planted arm."""
    arm = figures("calibration")["planted arm"]
    before, after = (arm[f"tip at held-out poses, {when}"] for when in ("before", "calibrated"))
    yield f"at held-out poses from {before:.2f} to {after:.2f} mm."
    beta, stiffness, area = (arm[f"{what}, largest error [%]"] for what in ("beta", "stiffness", "area"))
    yield f"by at most {beta:.2f} %, a chamber's stiffness by {stiffness:.1f} % and its area by {area:.1f} %."


def calibration_rows():
    """The table *Calibration*, of real logs."""
    made = figures("calibration")
    wires = made["draw wires to section length at rest, RMS"]
    one, other = (f"{wires[arm]:.2f}" for arm in ("apr5", "apr4"))
    yield row("length of a section from draw wires at rest, two arms", f"RMS {one} and {other} mm")
    *blocks, day = made["trunk, 3D RMSE"]
    maps = "linear", "cubic", "network"
    same = "; ".join(f"{fmean(block[name] for block in blocks):.1f}" for name in maps)
    yield row("tip of a trunk from motor angles: a line; a cubic; the network", f"{same} mm")
    other = "; ".join(f"{day[name]:.1f}" for name in maps)
    yield row("the same, on another day", f"{other} mm")
    psi = made["pressures of another day, RMS [psi]"]
    ways = (f"{psi[f'of {arm}, the commands']:.2f}" for arm in ("apr4", "apr5"))
    yield row("pressures of another day, two ways: commands", "{} and {} psi".format(*ways))
    yield row("the same, regulators fitted to one day", "{} and {} psi".format(*regulators_psi()))


def regulators_psi():
    """Errors of pressures of another day, by fitted regulators, two ways."""
    psi = figures("calibration")["pressures of another day, RMS [psi]"]
    return [f"{psi[way]:.2f}" for way in ("of apr4, fitted to apr5", "of apr5, fitted to apr4")]


def missed_rows():
    """The rows of *What was missed* whose files have all of their numbers."""
    yield row("`analytic`, uniform in volume: 95 %", "3 mm", f"{figures('analytic')['even_p95_mm']:.2f} mm")
    yaw = mean("rod", "with", "0 g", "yaw_deg")
    yield row("rods, `analytic`: yaw error on the circle", "3 deg", f"{yaw} deg")
    sbx, sb3, analytic = (one["measured"].split()[0] for one in figures("race")["targets"])
    title = "SBX: [time to 5 mm](speed.md#time-to-learn), over `analytic`'s"
    yield row(title, "20", f"{float(analytic):.1f}")
    yield row(
        "SBX; sb3-contrib: time to 5 mm, over `quick`'s", "5; 15", f"{float(sbx):.1f}; {float(sb3):.1f}"
    )
    ratio = fmean(values("open", "with", "0 g", "translation_mm")) / figures("analytic")["circle_mean_mm"]
    yield row("`analytic`, circle on twins, divided by that in simulation", "2", f"{ratio:.1f}")
    psi = ", ".join(regulators_psi())
    yield row("real regulators, another day's pressures", "0.5 psi", f"{psi} psi")


def readme_rows():
    """The table of README."""
    circle = (mean(arms, "payload", "0 g", "rmse_mm") for arms in ("open", "rod"))
    yield row("circle, 160 mm wide: RMSE", *circle, "11.59")
    heavy = (max(values(arms, "payload", "1000 g", "max_mm")) for arms in ("open", "rod"))
    yield row("circle with 1 kg: largest", *(f"{error:.1f}" for error in heavy), "23.76")
    yield f"| pipe of 300 mm: mean in X/Y/Z | {pipe_mm('pipe', 'as shown')} | | 8.93/5.34/5.13 |"


TABLES = {
    "docs/results.md": (
        main_rows,
        missed_rows,
        circle_rows,
        load_rows,
        lap_rows,
        pipe_rows,
        held_out_rows,
        calibration_rows,
    ),
    "docs/trust.md": (arm_rows,),
    "docs/speed.md": (race_rows, step_rows, gpu_rows),
    "README.md": (readme_rows,),
}


@pytest.mark.parametrize(("page", "rows"), [(page, rows) for page, many in TABLES.items() for rows in many])
def test_tables_are_those_of_the_files(page, rows):
    lines = (ROOT / page).read_text("utf-8").splitlines()
    expected = list(rows())
    assert len(expected) > 2
    assert [line for line in expected if line not in lines] == []


@pytest.mark.parametrize(
    ("page", "phrases"),
    [("docs/trust.md", minutes_phrases), ("docs/results.md", calibration_phrases)],
)
def test_sentences_are_those_of_the_files(page, phrases):
    text = " ".join((ROOT / page).read_text("utf-8").split())
    assert [phrase for phrase in phrases() if phrase not in text] == []
