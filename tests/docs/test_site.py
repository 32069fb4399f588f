"""The site builds without a warning, links lead somewhere, and results keep no path of a machine."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from train.runs.evaluate import Summary

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs", reason="pip install -e '.[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr
    assert "equilibrium" in (tmp_path / "api/index.html").read_text("utf-8")  # docstrings are read


def prose(page):
    """Return a page without its blocks of code."""
    return re.sub(r"```.+?```", "", page.read_text("utf-8"), flags=re.S)


def anchors(page):
    """Return the anchors of a page's headings, as mkdocs and GitHub make them."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def links(page):
    """Return what a page links to, other sites left out."""
    pairs = re.findall(r"\]\(([^)]+)|src=\"([^\"]+)", prose(page))
    return [target for pair in pairs for target in pair if target and "://" not in target]


def test_there_are_links():
    assert len(links(ROOT / "docs/index.md")) > 10 and sum(len(links(page)) for page in PAGES) > 120


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_and_headings(page):
    for link in links(page):
        name, _, anchor = link.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.is_file(), link
        assert not anchor or anchor in anchors(file), link


@pytest.mark.parametrize("file", sorted((ROOT / "docs/results").glob("*.json")), ids=lambda file: file.stem)
def test_results_keep_no_path_of_a_machine(file):
    assert not re.findall(r'(?:^|["\s=:])(?:/|~/|[A-Z]:\\)\w[^"\s]*', file.read_text("utf-8"))


def test_the_list_of_files_has_each_result_with_its_command_and_commit():
    page = (ROOT / "docs/results.md").read_text("utf-8")
    rows = re.findall(r"^- \[(\S+)\]\(results/\1\), (\w{7}): `([^`]+)`(?:, now `[^`]+`)?$", page, re.M)
    assert sorted(name for name, *_ in rows) == sorted(f.name for f in (ROOT / "docs/results").glob("*.json"))
    for name, commit, beginning in rows:
        if not beginning.startswith("python -m "):
            beginning = f"python -m benchmarks {beginning}"
        made = json.loads((ROOT / "docs/results" / name).read_text("utf-8"))
        for source in made.get("kinds", {"": made}).values():  # `guard.json` has one for each kind of machine
            assert source["commit"].startswith(commit), name
            assert f"{source['command']} ".startswith(f"{beginning} "), name


def test_the_readme_s_figures_are_those_of_the_stored_run():
    made = json.loads((ROOT / "docs/results/demo.json").read_text("utf-8"))
    stored = dict(Summary(**made["figures"]).rows())
    table = (ROOT / "README.md").read_text("utf-8").split("held-out goals, ")[1].split("```")[0]
    printed = dict(re.findall(r"^ (\S.*?) {2,}(\S.*)$", table, re.MULTILINE)[1:])
    assert len(printed) > 5 and printed.items() <= stored.items()
