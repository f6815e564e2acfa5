"""The report of a comparison: introduction, tables and figures."""

import numpy as np
import pytest
from compare_support import flight, summary_of, uniform_map, view

from thermorender.apps.compare import (
    figures,
    report,
)
from thermorender.apps.compare.comparison import Options, compare


def test_the_introduction_explains_the_methods_of_the_run_only():
    few = summary_of([("B m", "B", "own"), ("C1 m", "C1", "own")])
    assert [name for name, _ in report.explained(few)] == ["B", "C1"]
    assert "rendered with true materials" in dict(report.explained(few))["C1"]
    more = summary_of([("D the frame's own mean", "D", None), ("C1 m, calibrated", "C1", "calibrated"),
                       ("C1 m, true objects", "C1", "own")], assumed=True)  # fmt: skip
    found = dict(report.explained(more))
    assert list(found) == ["C1", "D the frame's own mean", "calibrated", "true objects"]
    assert "rendered with the scene's materials" in found["C1"]
    page = report.introduction(more)
    assert "1 scene, 1 pose, 3 methods." in page and "true temperatures and the scene&#x27;s materials" in page
    assert "Errors are" not in report.introduction(summary_of(references=(False, False)))


def test_each_frame_has_its_own_scale_beside_the_common_one(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "save", lambda figure, *rest: drawn.append(figure))
    truth = np.linspace(290.0, 300.0, 64 * 80).reshape(64, 80).astype(np.float32)
    seen_from = view(np.ones(truth.shape, bool), truth=truth)
    figures.error_images(tmp_path / "a.png", seen_from, {"cold": truth - 40.0}, "reference, computed")
    axes = [axis for axis in drawn[0].axes if axis.images]
    titles = {axis.get_title(): axis.images[0].get_clim() for axis in axes}
    (name,) = [title for title in titles if title.startswith("own scale, ")]
    common, own = titles["cold"], titles[name]
    assert name == f"own scale, {own[0]:.1f}…{own[1]:.1f} °C"
    assert titles["reference, computed"] == common == pytest.approx((16.95, 26.75), abs=0.01)
    assert own == pytest.approx((common[0] - 40.0, common[1] - 40.0), abs=0.01) and "error" in titles


def test_tables_of_the_terminal_are_in_kelvin():
    ground = {"me_k": -1.0, "mae_k": 2.0, "sd_k": 3.0, "rmse_k": 4.0, "pixels": 5,
              "interval_95": {"me_k": None, "mae_k": (1.5, 2.5)}}  # fmt: skip
    pairs = [("a", "b", 1.0), ("a", "c", None), ("b", "c", 3.0)]
    apart = [{"one": one, "other": other, "me_k": k, "mae_k": k, "rmse_k": k, "pixels": 7} for one, other, k in pairs]
    summary = {"methods": {"B m": {"errors": {"radiometric": {"ground": ground}}}, "a": {"errors": None}},
               "scenes": [{"name": "known", "differences": []}, {"name": "real", "differences": apart}]}  # fmt: skip
    found, apart_shown = report.terminal(summary)
    assert found.rows == [("B m", "-1.000", "2.000", "1.50…2.50", "3.000", "4.000", "5")]
    assert apart_shown.rows == [
        ("", "b", "a", "+1.000", "1.000", "1.000", "7"),
        ("", "c", "a", "none", "none", "none", "7"),
    ]
    assert all(len(each.head) == len(each.rows[0]) for each in (found, apart_shown)) and "°C" not in str(found.head)
    summary["scenes"].append({"name": "other", "differences": apart[:1]})
    assert [row[0] for row in report.terminal(summary)[1].rows] == ["real", "real", "other"]


def test_axes_have_plain_numbers_and_legends_can_be_read(monkeypatch):
    monkeypatch.setattr(figures, "png", lambda drawing: drawing)
    own = [{"letter": letter, "map": "m", "bounds": "own", "seconds_per_frame": 0.01 * (k + 1),
            "errors": {"radiometric": {"ground": {"mae_k": 4.0 + 2.0 * k}}}}
           for k, letter in enumerate(("B", "C1"))]  # fmt: skip
    drawing = figures.error_and_time({"methods": dict(enumerate(own))})
    drawing.canvas.draw()
    (axis,) = drawing.axes
    labels = [each.get_text() for which in ("major", "minor") for each in axis.get_yticklabels(which=which)]
    assert {"4", "5", "6"} <= set(labels) and not any("$" in label for label in labels)
    assert axis.get_title() == "○ 2D translation  □ rendered"
    # Points of a figure at its resolution are larger than those of a page, of which 72 are 96 pixels.
    sizes = [each.get_fontsize() * figures.DPI / 96.0 for each in axis.get_legend().get_texts()]
    assert sizes and min(sizes) >= 9.0


def test_the_photograph_is_grey_where_there_is_no_terrain():
    known = np.array([[True, False, False]])
    seen_from = view(known, visible=np.array([[[0, 0, 0], [0, 0, 0], [90, 120, 200]]], np.uint8))
    shown = figures.shown_photograph(seen_from)
    # Black ground stays black, and the sky blue.
    assert shown.tolist() == [[[0, 0, 0], [136, 136, 136], [90, 120, 200]]] and not seen_from.visible[0, 1].any()


def test_names_cannot_break_the_page(ground, tmp_path):
    nasty = uniform_map(tmp_path / "n.npz", 0.5, name="<script>alert(1)<script>")
    compare([flight(ground, poses=1)], tmp_path / "c", [nasty], Options(settings={"rays": 2}))
    page = (tmp_path / "c/report.html").read_text()
    assert "<script>alert" not in page.replace("\\u003c", "") and "&lt;script&gt;alert" in page
    assert "rendered with true materials" in page
