"""The report of a comparison: introduction, tables and figures."""

import numpy as np
import pytest
from compare_support import flight, rendered, summary_of, uniform_map, view

from thermorender.apps.compare import (
    figures,
    report,
)
from thermorender.apps.compare.comparison import Options, compare


def test_the_introduction_explains_the_methods_of_the_run_only():
    few = summary_of(
        [("m on the photograph", "photograph", "own"), ("m as kelvin, true materials", "true-materials", "own")]
    )
    assert [name for name, _ in report.explained(few)] == ["map on the photograph", "map as kelvin, true materials"]
    assert "rendered with true materials" in dict(report.explained(few))["map as kelvin, true materials"]
    more = summary_of([("the frame's own mean", "frame-mean", None),
                       (rendered("m", ", calibrated"), "true-materials", "calibrated"),
                       (rendered("m", ", true objects"), "true-materials", "own")], assumed=True)  # fmt: skip
    found = dict(report.explained(more))
    assert list(found) == ["map as kelvin, true materials", "the frame's own mean", "calibrated", "true objects"]
    assert "rendered with the scene's materials" in found["map as kelvin, true materials"]
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
    assert name == f"own scale, {own[0]:.1f}…{own[1]:.1f} K"
    assert titles["reference, computed"] == common == pytest.approx((290.1, 299.9), abs=0.01)
    assert own == pytest.approx((common[0] - 40.0, common[1] - 40.0), abs=0.01) and "error" in titles


def test_tables_of_the_terminal_are_in_kelvin():
    ground = {"me_k": -1.0, "mae_k": 2.0, "sd_k": 3.0, "rmse_k": 4.0, "pixels": 5,
              "interval_95": {"me_k": None, "mae_k": (1.5, 2.5)}}  # fmt: skip
    pairs = [("a", "b", 1.0), ("a", "c", None), ("b", "c", 3.0)]
    apart = [{"one": one, "other": other, "me_k": k, "mae_k": k, "rmse_k": k, "pixels": 7} for one, other, k in pairs]
    summary = {"methods": {"b": {"errors": {"radiometric": {"ground": ground}}}, "a": {"errors": None}},
               "scenes": [{"name": "known", "differences": []}, {"name": "real", "differences": apart}]}  # fmt: skip
    found, apart_shown = report.terminal(summary)
    assert found.rows == [("b", "-1.000", "2.000", "1.50…2.50", "3.000", "4.000", "5")]
    assert apart_shown.rows == [
        ("", "b", "a", "+1.000", "1.000", "1.000", "7"),
        ("", "c", "a", "none", "none", "none", "7"),
    ]
    assert all(len(each.head) == len(each.rows[0]) for each in (found, apart_shown)) and "°C" not in str(found.head)
    summary["scenes"].append({"name": "other", "differences": apart[:1]})
    assert [row[0] for row in report.terminal(summary)[1].rows] == ["real", "real", "other"]


def test_printed_figures_have_plain_numbers_and_words_that_can_be_read_in_a_column():
    own = [{"kind": kind, "map": "m", "bounds": "own", "seconds_per_frame": 0.01 * (k + 1),
            "errors": {"radiometric": {"ground": {"mae_k": 4.0 + 2.0 * k}}}}
           for k, kind in enumerate(("photograph", "true-materials"))]  # fmt: skip
    drawing = figures.error_and_time({"methods": dict(enumerate(own))})
    drawing.canvas.draw()
    (axis,) = drawing.axes
    labels = [each.get_text() for which in ("major", "minor") for each in axis.get_yticklabels(which=which)]
    assert {"4", "5", "6"} <= set(labels) and not any("$" in label for label in labels)
    (legend,) = drawing.legends
    assert [each.get_text() for each in legend.get_texts()] == ["m", "on the photograph", "as kelvin, true materials"]
    # In a column of 85 mm, words of 7 points are those of a caption's size.
    assert drawing.get_size_inches()[0] * 25.4 == pytest.approx(85.0)
    words = [*legend.get_texts(), axis.xaxis.label, axis.yaxis.label, *axis.get_xticklabels()]
    assert min(each.get_fontsize() for each in words) >= 7.0
    inside = drawing.bbox.padded(1.0)
    assert all(inside.contains(*corner) for each in (legend, axis) for corner in each.get_tightbbox().corners())


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
