"""The commands and code of README, docs/ and examples/ run as written and print what the pages say.

Blocks ```python and ```bash of a page run in order in one temporary folder; a block ```text behind one of them is its
output. A block that cannot run begins with "# not run:" and the reason, which readers see too.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from thermorender.cli import registry

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
README = ROOT / "README.md"
SCRIPTS = sorted((ROOT / "examples").glob("[0-9]*.py"))
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))
NOT_RUN = "# not run: "
# Pages whose blocks take more than 8 s of one core.
SLOW = {
    "README.md", "concepts/error-budget.md", "concepts/frame.md", "concepts/plan.md", "guides/terrain.md",
    "start/first-comparison.md", "start/first-flight.md", "guides/campaign.md", "guides/cameras.md",
    "guides/cluster.md", "guides/compare.md", "guides/export.md", "guides/flight-logs.md", "guides/learned-maps.md",
    "guides/materials.md", "guides/python.md", "guides/simulator.md", "guides/studio.md", "guides/survey.md",
    "guides/weather.md", "guides/three-d.md", "guides/meshes.md", "guides/learned-materials.md",
    "reference/edits.md", "reference/flights.md",
    "examples/01_first_frame.py", "examples/02_day_over_your_terrain.py", "examples/03_map_against_render.py",
}  # fmt: skip
_BLOCK = re.compile(r"^```(python|bash|text)\n(.*?)^```$", flags=re.S | re.M)


def name_of(path):
    """The name of a page, script or notebook below docs/, or below the checkout."""
    return path.relative_to(DOCS if DOCS in path.parents else ROOT).as_posix()


def blocks(path):
    """[(language, code, expected output or None)] of a page's blocks that can run or state why not."""
    found = []
    for language, text in _BLOCK.findall(path.read_text(encoding="utf-8")):
        if language == "text":
            assert found and found[-1][2] is None, f"{name_of(path)}: an output without the code that prints it"
            found[-1] = (*found[-1][:2], text)
        else:
            found.append((language, text, None))
    return found


PAGES = [
    README,
    *(page for folder in ("start", "guides", "concepts", "reference") for page in sorted((DOCS / folder).glob("*.md"))),
]
PAGES = [page for page in PAGES if any(not code.startswith(NOT_RUN) for _, code, _ in blocks(page))]


def marked(paths):
    """Parameters of a test over paths, with those of SLOW marked as slow."""
    slow = pytest.mark.slow
    return [pytest.param(path, id=name_of(path), marks=[slow] if name_of(path) in SLOW else []) for path in paths]


def agrees(printed, expected):
    """Whether outputs agree: words exactly, numbers within 2 units of the last stated digit; "…" matches any lines."""
    number = r"-?\d+(?:\.\d+)?"
    patterns = []
    for line in expected.strip().splitlines():
        patterns.append(r"(?:.*\n)*?" if line.strip() == "…" else re.sub(number, _CAPTURE, _escaped(line)) + r"\s*\n")
    match = re.fullmatch("".join(patterns), printed.strip() + "\n")
    if match is None:
        return False
    kept = [line for line in expected.strip().splitlines() if line.strip() != "…"]
    stated = re.findall(number, "\n".join(kept))
    return all(
        abs(float(one) - float(other)) <= 2.0 * 10.0 ** -len(one.partition(".")[2])
        if "." in one else one == other
        for one, other in zip(stated, match.groups(), strict=True)
    )  # fmt: skip


_CAPTURE = r"(-?\\d+(?:\\.\\d+)?)"


def _escaped(line):
    """A regular expression for a line's words; numbers stay as they are, and runs of spaces match any."""
    return re.sub(r"(\\ )+", r"\\s+", re.escape(line.strip())).replace(r"\.", ".").replace(r"\-", "-")


def environment():
    """Environment in which a shell finds this Python's `thermorender`."""
    return dict(os.environ) | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "MPLBACKEND": "Agg"}


@pytest.mark.parametrize("page", marked(PAGES))
def test_blocks_run_and_print_what_the_page_says(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "__main__"}
    for language, code, expected in blocks(page):
        if code.startswith(NOT_RUN):
            assert len(code.partition("\n")[0]) > len(NOT_RUN) + 5, f"no reason is given: {code}"
            continue
        if language == "bash":
            command = ["bash", "-e", "-o", "pipefail", "-c", code]
            done = subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=1200)
            assert done.returncode == 0, f"{code}\n{done.stdout}\n{done.stderr}"
            printed = done.stdout
        else:
            capsys.readouterr()
            exec(compile(code, name_of(page), "exec"), namespace)
            printed = capsys.readouterr().out
        assert expected is None or agrees(printed, expected), f"{code}\nprinted\n{printed}\nand not\n{expected}"


def test_few_blocks_are_not_run():
    pages = [README, *sorted(DOCS.rglob("*.md"))]
    reasons = [code for page in pages for _, code, _ in blocks(page) if code.startswith(NOT_RUN)]
    assert len(reasons) <= 12, reasons


@pytest.mark.slow
@pytest.mark.parametrize("script", marked(SCRIPTS))
def test_examples_run(script, tmp_path):
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=1200
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout


def _roofs_look_colder(change, roof, before, after, pose, **_):
    """Roofs by kelvins and the rest by far less, at the same kinetic temperatures."""
    assert change[roof].mean() < -1.0 and 0.0 < np.abs(change[~roof]).mean() < 0.1 * -change[roof].mean()
    kinetic = (each.frame(pose).truth["kinetic_temperature"] for each in (before, after))
    np.testing.assert_array_equal(*kinetic)


def _surfaces_reflect_the_cold_sky(difference, frame, image, **_):
    assert -5.0 < np.nanmedian(difference) < 0.0
    assert frame.targets["marker"]["visible"] and image.std() > 0.0
    assert len(np.unique(frame.counts)) > len(np.unique(frame.display)) > 16


def _most_of_a_maps_error_is_an_offset(errors, constant, **_):
    assert 0.0 < constant < 10.0 and list(errors) == ["fok-1to1", "procedural-palette"]
    for error in errors.values():
        assert abs(error.mean()) > 0.5 * np.abs(error).mean()


# What each notebook says of its results, by the names of its variables.
STATED = {
    "edit_a_roof.ipynb": _roofs_look_colder,
    "first_frame.ipynb": _surfaces_reflect_the_cold_sky,
    "map_against_render.ipynb": _most_of_a_maps_error_is_an_offset,
}


@pytest.mark.slow
@pytest.mark.parametrize("notebook", [pytest.param(path, id=path.name) for path in NOTEBOOKS])
def test_results_of_notebooks_are_what_they_say(notebook, tmp_path, monkeypatch):
    import matplotlib

    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "__main__"}
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), notebook.name, "exec"), namespace)
    STATED[notebook.name](**namespace)


@pytest.mark.parametrize("notebook", [pytest.param(path, id=path.name) for path in NOTEBOOKS])
def test_notebooks_are_stored_without_outputs(notebook):
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        assert not cell.get("outputs") and cell.get("execution_count") is None


def test_readme_is_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 150


def test_links_of_the_readme_exist():
    for page in (README, ROOT / "CONTRIBUTING.md", ROOT / "examples" / "README.md"):
        for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / link).exists(), f"{page.name} links to {link}"


def labels_of(text):
    """The labels that a page declares, as MyST normalises them: `(label)=`, `{#label}` and `:name: label`."""
    found = re.findall(r"^\(([^()\n]+)\)=$|^\{[^}\n]*#([\w-]+)[^}\n]*\}$|^\s*:name: +(\S+)$", text, flags=re.M)
    return [" ".join("".join(each).lower().split()) for each in found]


def test_labels_are_unique_over_all_pages():
    """Sphinx knows labels by their name alone, whatever page declares them."""
    found = [(label, name_of(page)) for page in EVERY_PAGE for label in labels_of(page.read_text(encoding="utf-8"))]
    labels = [label for label, _ in found]
    assert labels and not [each for each in found if labels.count(each[0]) > 1]


EVERY_PAGE = [README, *(page for page in sorted(DOCS.rglob("*.md")) if "_build" not in page.parts)]


@pytest.mark.parametrize("page", [pytest.param(path, id=name_of(path)) for path in EVERY_PAGE])
def test_verbs_and_options_of_a_page_exist(page):
    """Every `thermorender VERB --option` on a page, in blocks and in sentences, is known to the parser."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    fenced = "\n".join(re.findall(r"^```(?:bash)?\n(.*?)^```$", text, flags=re.S | re.M))
    inline = re.findall(r"`thermorender ([a-z][^`\n]*)`", text)
    for command in re.findall(r"^ *thermorender ([a-z].*)", fenced, flags=re.M) + inline:
        words = command.split()
        assert words[0] in registry.verbs(), f"thermorender {command}"
        verb = registry.command(words[0])
        if getattr(verb, "commands", None) and len(words) > 1 and words[1] in verb.commands:
            verb = verb.commands[words[1]]
        known = {option for parameter in verb.params for option in parameter.opts} | {"--help", "--help-all"}
        given = {word.split("=")[0] for word in words[1:] if re.match(r"--?[a-z]", word)}
        assert given <= known, f"thermorender {command}"


def test_differing_outputs_are_detected():
    assert agrees("a 1.52 b\nc\n", "a 1.51 b\nc") and agrees("x\ny\nz\n", "x\n…\nz")
    assert not agrees("a 1.58 b\n", "a 1.51 b") and not agrees("a 3\n", "a 2") and not agrees("x\ny\n", "x\nz")
