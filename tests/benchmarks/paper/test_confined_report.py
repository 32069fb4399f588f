"""The report on confined spaces, its pictures and its film: nothing of made-up runs is hidden."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.paper import confined_film
from benchmarks.paper.confined_plots import outline_mm
from benchmarks.paper.confined_report import HTML_FILE, JSON_FILE, write_results
from benchmarks.paper.confined_stages import Scene, Trial, trainings, trials
from mjx_softarm.mechanics.pipe import CrossPipe, clearance
from tests.benchmarks.paper.confined_runs import (
    BOTH,
    DOWN,
    SPEC,
    TINY,
    N,
    X,
    calibrate,
    good_results,
    made_up,
    positions,
)


def test_outline_is_the_wall():
    pipe = CrossPipe.of_mm(300)
    for line in outline_mm(pipe):
        for x, z in 0.5e-3 * (line[:-1] + line[1:]):
            assert abs(clearance(pipe, np.array([x, 0.0, z]))) < 1e-9


def test_results_are_written_and_nothing_is_hidden(tmp_path, read_page):
    calibrate(tmp_path, TINY)
    changed = {}
    for trial in (Trial("pipe", 1, 0), Trial("narrow", 0, 0), Trial("narrow", 1, 0)):
        changed[trial] = made_up(trial.kind, fails=(0, 1, 2, 3))
        changed[trial].error[:] = changed[trial].arrival_s[:] = np.nan
    given = good_results(TINY)
    given = given._replace(trials={**given.trials, **changed})
    data = write_results(tmp_path, tmp_path / "out", TINY, given, "no OpenGL <here>", {"commit": "none"})
    page = read_page(tmp_path / HTML_FILE)
    assert page.n_pictures == 7
    for text in ("8.93", "5.34", "5.13", "11.29", "11.59", "no OpenGL <here>"):
        assert text in page.text
    assert f"not met: {X}: nan mm, 28 positions missed in 1 of 2 runs" in page.text
    assert f"not met: {BOTH}: 1 of 2" in page.text
    assert "twin 1: Springs: off <by> much" in page.text
    assert "7 of 10 goals are not met." in page.text
    written = json.loads((tmp_path / "out" / JSON_FILE).read_text("utf-8"))
    assert written["commit"] == "none"
    assert len(written["figures"]["runs"]) == len(trials(TINY)) == len(data["runs"])
    assert len(written["figures"]["trainings"]) == len(trainings(TINY))
    assert [row["x_mm"] is None for row in written["figures"]["runs"]].count(True) == 3
    pictures = {path.name for path in (tmp_path / "out").glob("*.png")}
    names = ("positions", "errors", "errors-narrow", "force", "success", "losses", "circle")
    assert pictures == {f"paper-confined-{name}.png" for name in names}
    assert all((tmp_path / "out" / name).stat().st_size < 150_000 for name in pictures)


def test_film_shows_the_pipe_and_the_path(tmp_path, monkeypatch):
    class Filmed:
        """A twin that is drawn as its time."""

        time_s = 0.0

        def write_pressures(self, pressure_kpa):
            self.time_s += 0.02

        def draw(self, renderer):
            return np.full((320, 240, 3), round(self.time_s), np.uint8)

        def motion_capture(self):
            tip_m = np.array([0.01 * self.time_s, 0.0, -0.45])
            return SimpleNamespace(tip_m=tip_m, tip_quaternion=DOWN)

        def renderer(self, width, height):
            return open("/dev/null")

    def go(arm, controller, goals, names, objects):
        for _ in range(500):
            arm.write_pressures(np.zeros(N))

    written = {}
    names, goals = positions("pipe")
    policy = SimpleNamespace(policy=SimpleNamespace(spec=SPEC))
    monkeypatch.setattr(confined_film, "scene_of", lambda *_: Scene(Filmed(), policy, goals, names))
    monkeypatch.setattr(confined_film, "operate", go)
    monkeypatch.setattr(confined_film, "write_gif", lambda path, images: written.update({path: images}))
    assert confined_film.film_pipe(tmp_path, TINY) == ""
    images = written[tmp_path / "pipe.gif"]
    assert [image.getpixel((0, 0))[0] for image in images] == list(range(len(images)))
    # The tip, at first straight below the crossing, then to the right; the wall on both sides.
    orange = [(np.asarray(image) == (224, 123, 40)).all(axis=-1) for image in images]
    across = np.array([np.argwhere(mask)[:, 1].mean() for mask in orange])
    assert abs(across[0] - 360) < 1.0 and np.all(np.diff(across) > 0)
    grey = (np.asarray(images[0])[:, 240:] == (154, 160, 166)).all(axis=-1)
    assert grey[:, :120].sum() == pytest.approx(grey[:, 120:].sum(), rel=0.2)
    assert grey.sum() > 28 * 21 + 500  # more than the positions' dots cover
