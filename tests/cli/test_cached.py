"""The verb `cache`: it lists what is kept, and removes what was used longest ago."""

import os

from typer.testing import CliRunner

from thermorender.cache import cache_folder, kept, trim
from thermorender.cli import app as cli


def files_of_a_megabyte(kind, count):
    """Write files of a kind, each used a minute after the one before."""
    folder = cache_folder(kind)
    folder.mkdir(parents=True)
    paths = [folder / f"{number:040x}.npz" for number in range(count)]
    for number, path in enumerate(paths):
        path.write_bytes(bytes(1_000_000))
        os.utime(path, (60.0 * number, 60.0 * number))
    (folder / "other.txt").write_text("not a file of the cache")
    return paths


def test_cache_lists_sizes_and_removes_the_least_recently_used(tmp_path, monkeypatch):
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path))
    paths = files_of_a_megabyte("tiles", 5)
    shown = CliRunner().invoke(cli.app, ["cache"])
    assert shown.exit_code == 0 and "0.005 GB" in shown.output and "1970-01-01 00:04Z" in shown.output
    done = CliRunner().invoke(cli.app, ["cache", "--shrink", "tiles=0.003"])
    assert done.exit_code == 0 and "tiles: 0.002 GB removed" in done.output
    assert [path.exists() for path in paths] == [False, False, True, True, True]
    assert (tmp_path / "tiles" / "other.txt").exists()


def test_a_file_in_use_is_kept_whatever_the_limit(tmp_path, monkeypatch):
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path))
    paths = files_of_a_megabyte("light", 3)
    assert trim("light", 0, keep=paths[0].name) == 2_000_000
    assert [path.name for _, _, path in kept("light")] == [paths[0].name]


def test_a_kind_that_does_not_grow_or_no_number_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path))
    for text in ("link=1", "tiles", "tiles=much", "tiles=-1", "tiles=nan"):
        done = CliRunner().invoke(cli.app, ["cache", "--shrink", text])
        assert done.exit_code != 0 and text in str(done.exception or done.output), text
