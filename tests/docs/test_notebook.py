"""The notebook runs from its log to its circle in an empty folder, and keeps no path of a machine."""

import resource
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "docs/first_policy.ipynb"


def cpu_seconds():
    """Return the time of processors that finished children took."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.mark.slow
def test_the_notebook_leads_to_a_policy_that_follows_a_circle(tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient", reason="pip install -e '.[docs]'")
    nbformat = pytest.importorskip("nbformat")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook, before_s = nbformat.read(FILE, 4), cpu_seconds()
    context = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=900, kernel_name="python3", resources=context).execute()
    assert cpu_seconds() - before_s < 600  # five minutes of two cores
    mean_mm, largest_mm, saturated = eval(notebook.cells[-2].outputs[0].data["text/plain"])
    assert mean_mm < 3.0 and largest_mm < 6.0 and saturated == 0


def test_the_notebook_keeps_no_path_of_a_machine():
    text = FILE.read_text("utf-8")
    paths = (str(ROOT), str(Path.home()), "/tmp/", "/home/", "site-packages")
    assert not [path for path in paths if path in text]
