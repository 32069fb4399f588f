"""The site builds without a warning, links lead somewhere, and results keep no path of a machine."""

import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from train.runs.evaluate import Summary

ROOT = Path(__file__).resolve().parents[2]


def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs", reason="pip install -e '.[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr
    assert "equilibrium" in (tmp_path / "api/index.html").read_text("utf-8")  # docstrings are read


def test_the_readme_s_links_lead_to_files():
    text = (ROOT / "README.md").read_text("utf-8")
    links = re.findall(r"\]\(([^)#]+)|src=\"([^\"]+)", text)
    targets = [target for pair in links for target in pair if target and "://" not in target]
    assert targets and not [target for target in targets if not (ROOT / target).is_file()]


@pytest.mark.parametrize("file", sorted((ROOT / "docs/results").glob("*.json")), ids=lambda file: file.stem)
def test_results_keep_no_path_of_a_machine(file):
    assert not re.findall(r'(?:^|["\s=:])(?:/|~/|[A-Z]:\\)\w[^"\s]*', file.read_text("utf-8"))


def test_the_table_of_files_has_each_result_with_its_command_and_commit():
    page = (ROOT / "docs/results.md").read_text("utf-8")
    rows = re.findall(r"^\| \[(\S+)\]\(results/\1\) \| (.*) \| (\w{7}) \|", page, re.MULTILINE)
    assert sorted(name for name, *_ in rows) == sorted(f.name for f in (ROOT / "docs/results").glob("*.json"))
    for name, command, commit in rows:
        made = json.loads((ROOT / "docs/results" / name).read_text("utf-8"))
        for source in made.get("kinds", {"": made}).values():  # `guard.json` has one for each kind of machine
            assert source["commit"].startswith(commit), name
            if command.startswith("`"):
                assert re.sub(r" --out \S+", "", source["command"]) == command.strip("`"), name


def test_the_readme_s_figures_are_those_of_the_stored_run():
    made = json.loads((ROOT / "docs/results/learning.json").read_text("utf-8"))
    [quick] = [group for group in made["figures"]["groups"] if group["preset"] == "quick"]
    [run] = [run for run in quick["runs"] if run["seed"] == 0]
    names = {field.name for field in dataclasses.fields(Summary)}
    stored = dict(Summary(**{name: value for name, value in run.items() if name in names}).rows())
    table = (ROOT / "README.md").read_text("utf-8").split("held-out goals, ")[1].split("```")[0]
    printed = dict(re.findall(r"^ (\S.*?) {2,}(\S.*)$", table, re.MULTILINE)[1:])
    assert len(printed) > 5 and printed.items() <= stored.items()
