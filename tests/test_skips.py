"""The tests' own files: the list of skips names existing tests, and test data are small and have a source."""

import re
from pathlib import Path

from support import HERE, allowed_skips


def test_the_list_names_existing_tests_with_reasons():
    for name, reason in allowed_skips().items():
        file, _, function = name.partition("::")
        (path,) = [path for folder in (HERE, HERE.parent / "validation") for path in folder.rglob(file)]
        assert re.search(rf"^def {function}\(", path.read_text("utf-8"), re.M), name
        assert len(reason) > 20, name


def test_test_data_are_small_and_each_file_has_a_source():
    folder = Path(HERE, "data")
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 3_000_000
    listed = (folder / "README.md").read_text("utf-8")
    for path in files:
        name = path.relative_to(folder).as_posix()
        assert name == "README.md" or name in listed or f"{path.parent.relative_to(folder).as_posix()}/" in listed, name
