"""Commands that README and pages print: the programs take all of them, and most are run, shortened."""

import functools
import json
import re
import shlex
import shutil
import subprocess
import tomllib
from glob import glob
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from calib import demo
from mjx_softarm import ArmSpec
from mjx_softarm._support import cli
from mjx_softarm.policy.file import SHIPPED, load_policy
from train.runs import arm_model

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")),
]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
# A learner that docs/extend.md adds; see test_extend.py.
ADDED = "python -m train reach --learner restless"
WORDS = {"LOGS": "a.csv", "POLICY": "policy.npz", "--goal=...": "--goal=0,0,-600,0,0,0"}  # stand for others


def commands(page):
    """Return the commands of a page's sh blocks, without comments."""
    blocks = re.findall(r"^ *```sh\n(.+?)^ *```", (ROOT / page).read_text("utf-8"), re.M | re.S)
    lines = [line.split("#")[0].strip() for block in blocks for line in block.splitlines()]
    return [part.strip() for line in lines if line for part in line.split("&&")]


def inline(page):
    """Return the commands that a page names within its sentences."""
    text = re.sub(r"```.+?```", "", (ROOT / page).read_text("utf-8"), flags=re.S)
    return [" ".join(found.split()) for found in re.findall(r"`(python -m [^`]+)`", text)]


def stored():
    """Return the commands that made the results. The results' page has their beginnings."""
    made = [json.loads(file.read_text("utf-8")) for file in (ROOT / "docs/results").glob("*.json")]
    return {source["command"] for one in made for source in one.get("kinds", {"": one}).values()}


def is_ours(command):
    return re.match(r"python -m (mjx_softarm|train|calib|benchmarks)\b", command) and not command.startswith(
        ADDED
    )


def status_of(command):
    """Run a command of this project in this process; return its exit status."""
    _, _, module, *words = shlex.split(command)
    words = [file for word in words for file in (sorted(glob(word)) or [WORDS.get(word, word)])]
    return import_module(f"{module}.__main__").main(words)


CALLS = sorted({call for page in PAGES for call in commands(page) if is_ours(call)})
NAMED = sorted({call for page in PAGES for call in inline(page) if is_ours(call)} | stored() - {*CALLS})
OTHERS = sorted({call for page in PAGES for call in commands(page) if not is_ours(call)})
PYDOC = sorted(
    {call.split()[-1] for page in PAGES for call in inline(page) if " -m pydoc " in call} - {"MODULE"}
)


def test_there_are_commands():
    assert len(CALLS) > 50 and len(NAMED) > 20 and len(OTHERS) > 8 and len(PYDOC) > 5


@pytest.fixture
def parsed_alone(monkeypatch):
    """Let commands read their options and do nothing."""
    parse = cli.parse
    monkeypatch.setattr(cli, "parse", lambda *given: parse(*given) and (lambda: 0))


@pytest.mark.usefixtures("parsed_alone")
@pytest.mark.parametrize("call", CALLS)
def test_the_options_of_a_command_are_known(call, capsys):
    assert status_of(call) == 0, capsys.readouterr().err


@pytest.mark.usefixtures("parsed_alone")
@pytest.mark.parametrize("call", NAMED)
def test_a_command_within_a_sentence_is_one_or_begins_one(call, capsys):
    assert status_of(call) == 0 or "Missing from" in capsys.readouterr().err


@pytest.mark.parametrize("call", OTHERS)
def test_commands_of_other_programs_name_what_there_is(call):
    program, *words = call.removeprefix("python -m ").split()
    if program == "make":
        subprocess.run(["make", "-n", *words], cwd=ROOT, stdout=subprocess.DEVNULL, check=True)
    elif program == "pip":
        assert {*re.search(r"\[(.+)\]", call)[1].split(",")} <= {*EXTRAS}
    elif program == "pytest":
        assert (ROOT / words[0]).exists()
    else:
        assert program == "cmake" or call.startswith(ADDED)  # tests/export/test_cpp.py builds


@pytest.mark.parametrize("module", PYDOC)
def test_modules_to_read_about_exist(module):
    assert find_spec(module)


def python_blocks(page):
    return re.findall(r"^```python\n(.+?)^```", (ROOT / page).read_text("utf-8"), re.M | re.S)


@pytest.mark.slow
def test_the_readme_s_environment_steps(capsys):
    exec(python_blocks("README.md")[0], {})
    tip_error_mm, saturated = map(float, capsys.readouterr().out.split())
    assert 0.0 < tip_error_mm < 1e3 and 0.0 < saturated < 9.0


def test_the_readme_s_policy_acts(tmp_path, monkeypatch):
    shutil.copy(SHIPPED, tmp_path / "policy.npz")
    monkeypatch.chdir(tmp_path)
    pose, goal = load_policy(SHIPPED).workspace[:2]
    found = {"pose": pose, "goal": goal}
    exec(python_blocks("README.md")[1], found)
    assert found["reference"].length_m.shape == (9,)


def test_a_program_of_one_s_own_gives_goals(tmp_path, monkeypatch, capsys):
    shutil.copy(SHIPPED, tmp_path / "policy.npz")
    monkeypatch.chdir(tmp_path)
    exec(python_blocks("docs/deploy.md")[0].replace("500", "20"), {})
    assert len(capsys.readouterr().out.splitlines()) >= 22  # a tick each


# Journeys: the commands of the pages in the order of the site, with fewer poses and steps.
NAMES = ("your-arm", "why", "calibrate", "train", "deploy", "export", "see")
JOURNEY = ("README.md", *(f"docs/{name}.md" for name in NAMES))
FEWER = (
    (r"--poses \d+", "--poses 24"),
    (r"--points \d+", "--points 2"),
    (r"(record --arm twin:0) ", r"\1 --poses 24 "),
    (
        r"(train (reach|imitate|sweep) .*--(preset|calibration).*)",
        r"\1 --learner.total-env-steps 2048 --env.n-poses 256",
    ),
)
LEFT_OUT = (
    "python -m benchmarks",  # hours, or a machine of their own; tests/benchmarks
    "my_program",  # the user's
    "mjx_softarm.view",  # serves until Ctrl-C, but for --html; tests/view
)
DRIVER = """
from calib.demo import planted_arm
from mjx_softarm import ArmSpec
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.instruments import Build

class Arm(Twin):
    def __init__(self):
        super().__init__(0, planted_arm(ArmSpec.default(), seed=0), build=Build(gap=0.0))
"""
GOALS = "x [mm],y [mm],z [mm],yaw [deg],pitch [deg],roll [deg]\n0,0,-630,0,0,0\n"


def steps(page):
    for call in filter(is_ours, commands(page)):
        if "--html" in call or not any(text in call for text in LEFT_OUT):
            yield functools.reduce(lambda text, rule: re.sub(*rule, text), FEWER, call)


def clear(call):
    """Remove what a command is to write."""
    if target := re.search(r"--out (\S+)", call):
        shutil.rmtree(target[1], ignore_errors=True)
        Path(target[1]).unlink(missing_ok=True)


@pytest.fixture
def journey(tmp_path, monkeypatch):
    """A folder with a user's files: a driver, logs, goals."""
    for module, name, value in (
        (demo, "N_POSES", 80),
        (demo, "N_STEPS", 3),
        (arm_model, "SCHEDULE", arm_model.SCHEDULE._replace(n_updates=200)),
        (arm_model, "N_TRAINING", 1024),
        (arm_model, "N_JUDGING", 256),
    ):
        monkeypatch.setattr(module, name, value)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("my_arm.py").write_text(DRIVER)
    Path("goals.csv").write_text(GOALS)
    for file in demo.write_demo(Path("user"), ArmSpec.default(), seed=0):
        shutil.copy(file, file.name)
    shutil.copy("poses.csv", "before.csv")
    shutil.copy("poses.csv", "after.csv")


@pytest.mark.slow
@pytest.mark.usefixtures("journey")
def test_the_pages_commands_run_in_the_order_of_the_site(capfd):
    for page in JOURNEY:
        for call in steps(page):
            clear(call)
            status = status_of(call)
            allowed = {0, 1} if re.search("calib run|calib check|deploy (run|measure)", call) else {0}
            assert status in allowed, f"{page}: {call}: {status}\n{capfd.readouterr().err}"
