"""The report: what stands in it, and that nothing of a log can break it."""

import json

import numpy as np
from matplotlib.figure import Figure

from calib.report.page import ReportTable, Section, to_html, to_json


def make_sections(warnings=()):
    table = ReportTable(("", "beta"), (("spring 0", np.float64(0.931234)), ("spring 1", np.int64(7))))
    figure = Figure()
    figure.add_subplot().plot([0, 1])
    data = {"beta": np.array([0.93, np.nan])}
    return (
        Section("Springs", "What was fitted.", (table,), warnings, data, (("a plot", figure),)),
        Section("Chambers", "Not fitted."),
    )


def test_page_needs_no_other_file_and_names_and_findings_are_text_not_markup():
    markup = "<script>alert(1)</script>"
    page = to_html(markup, make_sections((markup,)), [markup], {markup: markup})
    assert "<script" not in page and page.count("&lt;script&gt;alert(1)") == 6  # the title stands twice
    assert "<td>0.9312</td>" in page and "<td>7</td>" in page
    assert page.count("src=") == page.count('src="data:image/png;base64,') == 1


def test_json_has_the_same_figures_and_says_whether_to_trust_them():
    provenance = {"commit": "0123abc", "packages": {"numpy": "2.0"}}
    data = json.loads(json.dumps(to_json(make_sections(), ["a finding"], provenance), allow_nan=False))
    assert data["trustworthy"] is True and data["findings"] == ["a finding"]
    assert data["parts"]["Springs"] == {"figures": {"beta": [0.93, None]}, "warnings": [], "notes": []}
    assert data["provenance"] == provenance
    assert to_json(make_sections(("no",)), [], {})["trustworthy"] is False
