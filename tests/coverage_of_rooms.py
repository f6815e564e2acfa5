"""Line coverage of each room of the package from coverage's JSON report; status 1 where one is below FLOOR."""

import json
import sys
from collections import Counter
from pathlib import Path, PurePath

FLOOR = 85.0  # per cent of lines


def rooms(report):
    """{room: (lines covered, lines)} of a report of `coverage json`; modules outside any folder are "thermorender"."""
    covered, lines = Counter(), Counter()
    for file, found in report["files"].items():
        parts = PurePath(file).parts
        # The last folder of the name, as a checkout may be called so too.
        inside = parts[len(parts) - parts[::-1].index("thermorender") :]
        room = "/".join(inside[: 2 if inside[0] == "apps" else 1]) if len(inside) > 1 else "thermorender"
        covered[room] += found["summary"]["covered_lines"]
        lines[room] += found["summary"]["num_statements"]
    return {room: (covered[room], lines[room]) for room in sorted(lines) if lines[room]}


def main(path):
    """Print the table and return the exit status."""
    found = rooms(json.loads(Path(path).read_text(encoding="utf-8")))
    print(f"{'room':<14}{'lines':>7}{'covered':>9}")
    low = []
    for room, (covered, lines) in found.items():
        share = 100.0 * covered / lines
        low += [room] if share < FLOOR else []
        print(f"{room:<14}{lines:>7}{share:>7.1f} %{f'  below {FLOOR:g} %' if share < FLOOR else ''}")
    return 1 if low or not found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
