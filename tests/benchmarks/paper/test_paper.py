"""The benchmark of the paper's open-space experiments, on made-up runs whose figures are known by hand."""

import dataclasses
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from benchmarks.harness import parallel
from benchmarks.harness.parallel import JobError
from benchmarks.paper import experiments as paper
from benchmarks.paper import film as paper_film
from benchmarks.paper import report_open as paper_report
from benchmarks.paper import stages as paper_stages
from benchmarks.paper.measure import Followed, figures, load_followed, measure, save_followed
from benchmarks.paper.report_open import HTML_FILE, JSON_FILE, write_results
from benchmarks.paper.stages import SMOKE, Case, Settings, cases, claim, policy_folder, result_file
from benchmarks.paper.summary import check_goals, rows, spread, summarise
from mjx_softarm import ArmSpec
from mjx_softarm.deploy.faults import Event, Fault
from mjx_softarm.deploy.loop import Controller, Phase
from mjx_softarm.deploy.session import Arrival, Run
from mjx_softarm.logs.schema import Log
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.workspace import circle_poses
from mjx_softarm.policy.file import policy_from_actor, save_policy
from mjx_softarm.policy.runtime import PolicyRunner
from mjx_softarm.sensing.sensors import SensorParams, frequency_from_length

SPEC = ArmSpec.default()
N = SPEC.n_chambers
TINY = Settings(twins=(0, 1), seeds=(0,), n_points=3, loads_g=(500, 1000))


def make_policy(make_arm_model, spec=SPEC):
    """A policy whose actor always asks for the middle of its range."""
    dense = {"head": {"kernel": np.zeros((18, 2 * N)), "bias": np.zeros(2 * N)}}
    model = make_arm_model(N)
    workspace = np.float32(np.concatenate([circle_poses(), circle_poses() + np.float32(50.0)]))
    return policy_from_actor({"params": dense}, spec, RewardConfig(), model._replace(workspace=workspace), {})


def made_up(error_mm, n_points=3, saturated=(), told=0):
    """A run that is off by so much in x and half a degree in yaw at every point."""
    error = np.zeros((n_points, 6))
    error[:, 0], error[:, 3] = error_mm, -0.5
    mask = np.zeros((n_points, N), bool)
    for point, chamber in saturated:
        mask[point, chamber] = True
    events = np.array([told if fault is Fault.SATURATED else 0 for fault in Fault])
    point = np.repeat(np.arange(n_points), 4)
    trace = np.full((len(point), N), 0.2)
    return Followed(
        goal=circle_poses(n_points).astype(float),
        error=error,
        believed=0.5 * error,
        saturated=mask,
        events=events,
        latency_s=np.array([1e-4, 3e-4]),
        time_s=0.5 * np.arange(len(point)),
        point=point,
        reference_m=trace,
        spring_m=trace + 1e-3,
        pressure_kpa=100 * trace,
    )


def good_results(settings=TINY):
    """Results that meet every goal."""
    given = {}
    for case in cases(settings):
        error_mm = {"without": 10.0, "with": 4.0, "gradient": 5.0}[case.method] + case.twin
        hit = case.method == "gradient" or case.load_g == 1000
        given[case] = made_up(error_mm - 0.5, saturated=[(1, 2)] if hit else [], told=2 if hit else 0)
    return given


def unmet(results):
    return [check.text for check in check_goals(rows(results)) if not check.met]


def test_three_twins_and_three_seeds_are_75_runs():
    found = cases(Settings())
    assert len(found) == len(set(found)) == 3 * 3 * (2 + 6) + 3
    assert sum(case.method == "gradient" for case in found) == 3


def test_errors_are_averaged_over_the_window_of_rest(make_arm_model):
    policy = make_policy(make_arm_model)
    controller = Controller.of(policy)
    window, n_rows = controller.window, 3 * controller.window
    goals = circle_poses(2).astype(float)
    tip_mm = np.tile(goals[1, :3] + [3.0, 4.0, 0.0], (n_rows, 1))
    tip_mm[:-window] += 500.0  # on its way: does not count
    tip_mm[-window:, 2] += np.where(np.arange(window) % 2, 1.0, -1.0)[:window] - (window % 2) / window
    tip_mm[-window:, 2] -= tip_mm[-window:, 2].mean() - goals[1, 2]
    pressure_kpa = np.zeros((n_rows, N))
    pressure_kpa[:, 4], pressure_kpa[:, 5] = 19.97, -40.0
    spring_m, reference_m = np.full((n_rows, N), 0.2), np.full((n_rows, N), 0.2)
    reference_m[:, 4] += 0.005  # asked for longer than the greatest pressure makes it
    reference_m[:, 5] -= 0.0005  # within the tolerance
    reference_m[:, 6] += 0.005  # off, but not at a limit
    log = Log(
        source="made up",
        row=np.arange(n_rows),
        time_s=0.02 * np.arange(n_rows),
        frequency_hz=frequency_from_length(spring_m, policy.sensor),
        pressure_kpa=pressure_kpa,
        tip_m=1e-3 * tip_mm,
        tip_quaternion=np.tile([np.cos(np.radians(5)), 0, 0, np.sin(np.radians(5))], (n_rows, 1)),
        reference_m=reference_m,
        goal=np.tile(goals[1], (n_rows, 1)),
    )
    arrival = Arrival(goals[1], goals[1] + [1.0, 0, 0, 0, 0, 0], n_rows - 1)
    events = (Event(Fault.SATURATED, ""), Event(Fault.SATURATED, ""))
    run = Run(log, (arrival,), events, np.array([1e-4] * 10), Phase.DONE, False)
    followed = measure(run, controller, goals)
    assert np.allclose(followed.error[1], [3, 4, 0, 10, 0, 0], atol=1e-6)
    assert np.isnan(followed.error[0]).all()
    assert np.flatnonzero(followed.saturated[1]).tolist() == [4]
    assert not followed.saturated[0].any()
    assert np.allclose(followed.spring_m, 0.2)
    assert set(followed.point) == {1}
    row = figures(followed)
    assert (row["reached"], row["points"], row["saturation_events"]) == (1, 2, 2)
    assert np.isclose(row["believed_mm"], 1.0)


def test_figures_of_a_run_by_hand():
    followed = made_up(0.0)
    followed.error[:] = [[3, 4, 0, 1, -2, 0], [0, 0, 1, -3, 0, 3], [np.nan] * 6]
    followed.saturated[0, [1, 2]] = followed.saturated[1, 2] = True
    row = figures(followed)
    assert np.isclose(row["translation_mm"], 3.0)
    assert np.isclose(row["rmse_mm"], np.sqrt(13.0))
    assert row["max_mm"] == 5.0
    assert (row["yaw_deg"], row["pitch_deg"], row["roll_deg"]) == (2.0, 1.0, 1.5)
    assert (row["saturated_points"], row["saturated_chambers_max"]) == (2, 2)
    assert (row["reached"], row["points"]) == (2, 3)


def test_run_without_an_arrival_has_no_error():
    followed = made_up(0.0)
    followed.error[:] = followed.believed[:] = np.nan
    row = figures(followed)
    assert np.isnan(row["translation_mm"])
    assert np.isnan(row["believed_mm"])
    assert row["reached"] == 0


def test_spread_by_hand():
    assert spread([1.0, 2.0, 6.0]) == pytest.approx((3.0, np.sqrt(14 / 3), 1.0, 6.0))
    assert np.isnan(spread([1.0, np.nan])).all()


def test_summary_groups_methods_and_loads():
    found = {(item["method"], item["load_g"]): item for item in summarise(rows(good_results()))}
    assert set(found) == {("without", 0), ("gradient", 0), ("with", 0), ("with", 500), ("with", 1000)}
    unloaded = found["with", 0]
    assert unloaded["runs"] == 2
    assert unloaded["translation_mm"] == pytest.approx({"mean": 4.0, "std": 0.5, "min": 3.5, "max": 4.5})
    assert unloaded["paper"]["translation_mm"] == 11.59
    assert found["without", 0]["paper"]["yaw_deg"] == 13.72
    assert found["with", 1000]["paper"] == {"max_mm": 23.76}
    assert found["gradient", 0]["paper"] == {}


def test_goals_that_are_met():
    assert unmet(good_results()) == []


@pytest.mark.parametrize(
    ("case", "changed", "goal"),
    [
        (Case("with", 0, 0), made_up(9.0), "with S2R, mean translation at most 5 mm"),
        (Case("without", 0, 0), made_up(1.0), "translation without S2R over that with it, at least 2"),
        (Case("with", 0, 0, 500), made_up(9.0), "35 to 500 g, mean translation at most 6 mm"),
        (
            Case("with", 0, 0, 1000),
            made_up(20.1, told=1),
            "1 kg, largest translation of all runs at most 20 mm",
        ),
        (
            Case("with", 0, 0, 1000),
            made_up(4.0, saturated=[(0, 0)]),
            "1 kg, saturation detected and reported by the loop",
        ),
        (
            Case("with", 1, 0),
            made_up(4.0, saturated=[(2, 8)]),
            "with S2R, unloaded: no saturated chamber at any point",
        ),
    ],
)
def test_goal_that_is_missed_is_named(case, changed, goal):
    assert goal in unmet({**good_results(), case: changed})


def test_angle_that_is_off_misses_its_goal_alone():
    turned = made_up(4.0)
    turned.error[:, 4] = -7.0
    assert unmet({**good_results(), Case("with", 0, 0): turned}) == ["with S2R, mean pitch at most 3 deg"]


def test_gradient_descent_without_saturation_misses_its_goal():
    free = {case: made_up(5.0) for case in cases(TINY) if case.method == "gradient"}
    assert unmet({**good_results(), **free}) == ["gradient descent saturates at least one chamber"]


def test_run_that_missed_a_point_meets_no_goal_however_small_its_error():
    broken = made_up(0.1)
    broken.error[2] = np.nan
    missed = unmet({**good_results(), Case("with", 0, 0): broken})
    assert "with S2R, mean translation at most 5 mm" in missed
    assert "with S2R, unloaded: no saturated chamber at any point" in missed
    assert "every point of every run is arrived at" in missed


def test_what_was_not_measured_is_not_met():
    unloaded = {case: item for case, item in good_results().items() if not case.load_g}
    checks = {check.text: check for check in check_goals(rows(unloaded))}
    check = checks["1 kg, largest translation of all runs at most 20 mm"]
    assert (check.value, check.met) == ("not measured", False)


def test_result_comes_back_from_its_file(tmp_path):
    followed = made_up(1.5, saturated=[(0, 3)])
    save_followed(tmp_path / "run.npz", followed)
    for name, value in load_followed(tmp_path / "run.npz")._asdict().items():
        assert np.array_equal(value, getattr(followed, name), equal_nan=True), name


def fill(folder, settings):
    """Leave in a folder what training and calibration would."""
    for twin in (None, *settings.twins):
        for seed in settings.seeds:
            run = policy_folder(folder, twin, seed)
            run.mkdir(parents=True)
            (run / "evaluation.json").write_text(json.dumps({"circle_mean_mm": 1.25}))
    for twin in settings.twins:
        here = folder / f"twin{twin}" / "calibration"
        here.mkdir(parents=True)
        parts = {"Springs": {"warnings": ["off <by> much"] if twin else []}}
        (here / "report.json").write_text(json.dumps({"parts": parts}))


def test_results_are_written_and_nothing_is_hidden(tmp_path, read_page):
    fill(tmp_path, TINY)
    results = good_results() | {Case("with", 0, 0): made_up(6.0)}
    side = paper_film.Side("", "", (0, 1), circle_poses(3)[:, :3])
    frames = paper_film.frames([np.zeros((20, 15, 3), np.uint8)] * 3, np.zeros((3, 3)), side)
    paper_film.write_gif(tmp_path / "circle.gif", frames)
    data = write_results(tmp_path, tmp_path / "out", TINY, results, "", {"commit": "none"})
    page = read_page(tmp_path / HTML_FILE)
    assert page.n_pictures == 3 + len(TINY.loads_g) + 1
    assert "with S2R, mean translation at most 5 mm: 5.00 mm" not in page.text  # (5.5 + 4.5) / 2: is met
    assert "twin 1: Springs: off <by> much" in page.text
    assert "21.01" in page.text
    assert "3.89" in page.text
    written = json.loads((tmp_path / "out" / JSON_FILE).read_text("utf-8"))
    assert written["figures"] == json.loads(json.dumps(data))
    assert len(written["figures"]["runs"]) == len(cases(TINY))
    assert {item["simulated_mm"] for item in written["figures"]["simulated"]} == {1.25}
    on_twins = written["figures"]["simulated"][0]["on_twin_mm"]
    assert (on_twins["min"], on_twins["max"]) == (9.5, 10.5)
    pictures = sorted(path.name for path in (tmp_path / "out").glob("paper-*.png"))
    assert pictures == [
        "paper-circle.png",
        "paper-error.png",
        "paper-loads.png",
        "paper-pressures-1000g.png",
        "paper-pressures-500g.png",
    ]
    assert all((tmp_path / "out" / name).stat().st_size < 150_000 for name in pictures)
    assert (tmp_path / "out" / "paper-circle.gif").read_bytes()[:6] == b"GIF89a"


def no_pictures(*_):
    names = ("circle", "error", "loads", "pressures-500g", "pressures-1000g")
    return {name: (name, Figure()) for name in names}


class StillTwin:
    """A twin whose pictures show the time."""

    time_s = 0.0

    def write_pressures(self, pressure_kpa):
        self.time_s += 0.02

    def draw(self, renderer):
        return np.full((20, 15, 3), round(self.time_s), np.uint8)

    def motion_capture(self):
        return SimpleNamespace(tip_m=np.array([0.08, 0.0, -0.5]))


def test_twin_is_filmed_at_equal_times(tmp_path):
    twin = StillTwin()
    film = paper_film.Film(twin, None)
    for _ in range(round(200 / 0.02)):
        twin.write_pressures(np.zeros(N))
        film.take()
    taken = [picture[0, 0, 0] for picture in film.pictures]
    assert taken[:3] == [0, 1, 2]
    assert len(taken) == 201
    assert len(film.seen) == 201
    path_mm = 1e3 * np.array([seen.tip_m for seen in film.seen])
    side = paper_film.Side("", "", (0, 1), circle_poses(4)[:, :3])
    images = paper_film.frames(film.pictures, path_mm, side)
    shown = [image.getpixel((0, 19))[0] for image in images]
    assert len(images) == paper_film.MAX_FRAMES
    assert (shown[0], shown[-1]) == (0, 200)
    assert shown == sorted(shown)


def test_missed_goal_and_missing_film_stand_in_the_page(tmp_path, monkeypatch, read_page):
    monkeypatch.setattr(paper_report, "draw", no_pictures)
    fill(tmp_path, TINY)
    lost = made_up(60.0)
    lost.error[:] = np.nan
    results = good_results() | {Case("with", 0, 0): lost}
    write_results(tmp_path, tmp_path, TINY, results, "no OpenGL <here>", {})
    runs = json.loads((tmp_path / JSON_FILE).read_text("utf-8"))["figures"]["runs"]
    assert [row["translation_mm"] is None for row in runs].count(True) == 1
    page = read_page(tmp_path / HTML_FILE)
    assert "not met: with S2R, mean translation at most 5 mm" in page.text
    assert "NOT MET" in page.text
    assert "no OpenGL <here>" in page.text


def inline(jobs):
    return {name: function(*arguments) for name, function, arguments in jobs}


def test_interrupted_benchmark_does_only_what_is_missing(tmp_path, monkeypatch):
    done = []

    def follow(folder, settings, case):
        path = result_file(folder, case)
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            done.append(case)
            save_followed(path, good_results()[case])

    fill(tmp_path, TINY)
    for name, stub in {"in_parallel": inline, "follow_circle": follow}.items():
        monkeypatch.setattr(paper, name, stub)
    for module in (paper, paper_stages):
        monkeypatch.setattr(module, "train_policy", lambda *_: done.append("policy"))
    monkeypatch.setattr(paper_stages, "learn_twin", lambda *_: done.append("twin"))
    monkeypatch.setattr(paper_film, "film_circle", lambda *_: "not here")
    monkeypatch.setattr(paper_report, "draw", no_pictures)
    data = paper.run(tmp_path, tmp_path / "out", TINY)
    assert all(check["met"] for check in data["goals"])
    assert (done.count("twin"), done.count("policy")) == (2, 1 + 2)
    assert set(cases(TINY)) <= set(done)
    gone = cases(TINY)[3]
    result_file(tmp_path, gone).unlink()
    done.clear()
    paper.run(tmp_path, tmp_path / "out", TINY)
    assert [item for item in done if isinstance(item, Case)] == [gone]


def test_folder_of_other_settings_is_refused(tmp_path):
    claim(tmp_path, TINY)
    claim(tmp_path, dataclasses.replace(TINY, twins=(0, 1, 2), seeds=(5,)))
    with pytest.raises(JobError, match=r"settings.json: .*\(n_points 3, now 40\); choose another --out"):
        claim(tmp_path, dataclasses.replace(TINY, n_points=40))


def test_folder_from_before_a_setting_existed_has_its_default(tmp_path):
    claim(tmp_path, TINY)
    file = tmp_path / "settings.json"
    old = json.loads(file.read_text())
    del old["imitation"]
    file.write_text(json.dumps(old))
    claim(tmp_path, TINY)
    with pytest.raises(JobError, match=r"imitation \[\], now \['frozen=true'\]"):
        claim(tmp_path, dataclasses.replace(TINY, imitation=("frozen=true",)))


def test_training_starts_resumes_exports_or_does_nothing(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(paper_stages, "command", lambda log, *arguments: calls.append(arguments))
    settings = dataclasses.replace(TINY, preset="quick", training=("tqc.gamma=0.9",))
    run = policy_folder(tmp_path, 1, 2)

    def commands():
        calls.clear()
        paper_stages.train_policy(tmp_path, settings, 1, 2)
        return calls

    calibration = str(tmp_path / "twin1" / "calibration")
    start = ("reach", "--preset", "quick", "--seed", "2", "--out", str(run), "--calibration", calibration)
    assert commands() == [(*start, "--set", "tqc.gamma=0.9"), ("export", str(run))]
    run.mkdir()
    (run / "config.json").touch()
    assert commands() == [("reach", "--resume", str(run)), ("export", str(run))]
    (run / "evaluation.json").touch()
    assert commands() == [("export", str(run))]
    (run / "policy.npz").touch()
    assert commands() == []


def test_failed_training_says_how(tmp_path):
    with pytest.raises(JobError, match=r"exit status 2; .*run.log ends with\n(.*\n)*error: .*not the folder"):
        paper_stages.command(tmp_path / "run.log", "export", str(tmp_path / "nothing"))


def test_jobs_run_elsewhere_and_a_failure_is_named():
    assert parallel.in_parallel([("a", pow, (2, 3)), ("b", divmod, (7, 2))]) == {"a": 8, "b": (3, 1)}
    with pytest.raises(JobError, match="bad: ValueError: invalid literal"):
        parallel.in_parallel([("bad", int, ("x",))])


def test_cores_are_shared_out():
    assert parallel._shares([0, 1]) == [[0], [1]]
    assert parallel._shares([3]) == [[3]]
    assert parallel._shares(list(range(5))) == [[0, 2, 4], [1, 3]]


def test_without_s2r_the_nominal_policy_plans_and_the_springs_are_calibrated(tmp_path, make_arm_model):
    calibrated = SPEC.replace(sensor={"beta": 0.9, "delta_m": 0.004}, springs={"length_min_m": 0.1})
    for twin, spec in ((None, SPEC), (0, calibrated)):
        folder = policy_folder(tmp_path, twin, 0)
        folder.mkdir()
        save_policy(folder / "policy.npz", make_policy(make_arm_model, spec))
    chosen = paper_stages.controller(tmp_path, Case("without", 0, 0))
    assert np.array_equal(chosen.policy.sensor.beta, SensorParams.from_spec(calibrated).beta)
    assert chosen.policy.spec == SPEC
    pose, goal = circle_poses(2).astype(float)
    expected = PolicyRunner(make_policy(make_arm_model)).act(pose, goal).length_m
    assert np.allclose(chosen.plan(pose, goal, np.full(N, 0.2)), expected)
    assert not np.allclose(
        paper_stages.controller(tmp_path, Case("with", 0, 0)).plan(pose, goal, 0), expected
    )


def test_policy_goes_to_a_point_on_a_twin(tmp_path, make_arm_model):
    settings, case = dataclasses.replace(TINY, n_points=1), Case("with", 0, 0)
    folder = policy_folder(tmp_path, 0, 0)
    folder.mkdir()
    save_policy(folder / "policy.npz", make_policy(make_arm_model))
    paper_stages.follow_circle(tmp_path, settings, case)
    followed = load_followed(result_file(tmp_path, case))
    assert np.isfinite(followed.error).all()
    # The actor asks for the same springs wherever the goal is, and these the twin holds.
    last = np.flatnonzero(followed.point == 0)[-1]
    assert np.abs(followed.spring_m[last] - followed.reference_m[last]).max() < 2e-3
    assert np.linalg.norm(followed.error[0, :3]) > 10.0


def test_command_line_refuses_what_is_no_list_of_numbers(capsys):
    with pytest.raises(SystemExit):
        paper.main(["--twins", "0,a"])
    assert "got '0,a', expected integers" in capsys.readouterr().err


@pytest.mark.slow
def test_smoke(tmp_path, capsys):
    assert paper.main(["--smoke", "--only", "open", "--out", str(tmp_path / "run")]) == 0
    assert "goals" in json.loads((tmp_path / "run" / JSON_FILE).read_text("utf-8"))["figures"]
    assert len(list((tmp_path / "run" / "results").iterdir())) == len(cases(SMOKE))
    assert len(re.findall("^(met|NOT MET) ", capsys.readouterr().out, re.MULTILINE)) == 11
