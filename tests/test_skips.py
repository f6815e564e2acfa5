"""The tests' own files: the list of skips names tests that exist, and data are small and have a source."""

import re
from pathlib import Path

from conftest import HERE, allowed_skips


def test_the_list_names_tests_that_exist_and_says_why():
    for name, reason in allowed_skips().items():
        file, _, function = name.partition("::")
        assert re.search(rf"^def {function}\(", (HERE / file).read_text("utf-8"), re.M), name
        assert len(reason) > 20, name


def test_data_of_the_tests_is_small_and_each_file_has_its_source():
    folder = Path(HERE, "data")
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 3_000_000
    told = (folder / "README.md").read_text("utf-8")
    for path in files:
        name = path.relative_to(folder).as_posix()
        assert name == "README.md" or name in told or f"{path.parent.relative_to(folder).as_posix()}/" in told, name
