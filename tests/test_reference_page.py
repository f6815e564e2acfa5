"""The Python reference as Sphinx builds it."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import thermorender

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.mark.slow
def test_the_built_reference_has_every_public_name(tmp_path):
    for name in ("sphinx", "myst_nb", "numpydoc", "furo"):
        pytest.importorskip(name, reason="needs thermorender[docs]")
    for name in ("_ext", "_static", "conf.py", "reference/python.md"):
        copy = shutil.copytree if (DOCS / name).is_dir() else shutil.copy
        (tmp_path / "docs" / name).parent.mkdir(parents=True, exist_ok=True)
        copy(DOCS / name, tmp_path / "docs" / name)
    page = tmp_path / "docs/reference/python.md"

    def built():
        settings = "-E", "-b", "html", "-D", "root_doc=reference/python"
        command = ("sphinx", *settings, tmp_path / "docs", tmp_path / "html")
        return subprocess.run([sys.executable, "-m", *command], capture_output=True, text=True)

    assert built().returncode == 0
    html = (tmp_path / "html/reference/python.html").read_text(encoding="utf-8")
    for name in set(thermorender.__all__) - {"link"}:
        assert f'id="thermorender.{name}"' in html, name
    for name in ("Scene.with_weather", "Frame.apparent_temperature", "Renderer.frame"):
        assert f'id="thermorender.{name}"' in html, name
    assert 'id="thermorender.apps.link.connect"' in html
    assert not re.search(r"\.\. auto\w+::", html)
    # Directives as plain text end the build.
    text = page.read_text(encoding="utf-8")
    page.write_text(text.replace("{eval-rst}\n.. autoclass:: thermorender.Renderer", "text\n.. autoclass:: Renderer"))
    wrong = built()
    assert wrong.returncode != 0 and re.search(r"lacks .*\bRenderer\b", wrong.stderr)
