"""The report: what stands in it, and that nothing of a log can break it."""

import json
from html.parser import HTMLParser

import numpy as np
from matplotlib.figure import Figure

from calib.report.page import ReportTable, Section, to_html, to_json

PROVENANCE = {"commit": "0123abc", "packages": {"numpy": "2.0"}}


class Page(HTMLParser):
    """Texts, by tag, and that every tag is closed."""

    def __init__(self, page):
        super().__init__()
        self.open, self.texts = [], {}
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        if tag == "img":
            assert dict(attributes)["src"].startswith("data:image/png;base64,")  # no other file
        elif tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and data.strip():
            self.texts.setdefault(self.open[-1], []).append(data)


def make_parts(warnings=()):
    table = ReportTable(("", "beta"), (("spring 0", np.float64(0.931234)), ("spring 1", np.int64(7))))
    figure = Figure()
    figure.add_subplot().plot([0, 1])
    return (
        Section("Springs", "What was fitted.", (table,), warnings, {"beta": [0.93]}, (("a plot", figure),)),
        Section("Chambers", "Not fitted."),
    )


def test_names_and_findings_are_text_not_markup():
    findings = ["a.csv: <script>alert(1)</script>"]
    page = Page(to_html("<b>arm</b>", make_parts(("<i>",)), findings, {"x": "<u>"}))
    assert page.texts["h1"] == ["Calibration of <b>arm</b>"]
    assert set(page.texts) <= {"h1", "h2", "p", "td", "th", "li", "pre", "title", "style"}
    assert "a.csv: <script>alert(1)</script>" in page.texts["li"]


def test_json_has_the_same_figures_and_says_whether_to_trust_them():
    data = json.loads(json.dumps(to_json(make_parts(), ["a finding"], PROVENANCE)))
    assert data["trustworthy"] is True and data["findings"] == ["a finding"]
    assert data["parts"]["Springs"] == {"figures": {"beta": [0.93]}, "warnings": [], "notes": []}
    assert data["provenance"] == PROVENANCE
    assert to_json(make_parts(("no",)), [], {})["trustworthy"] is False
