"""Scaling of flights over workers, measured and simulated: `python -m validation.cluster`."""

from pathlib import Path

from validation.cluster import study
from validation.command import Out, conclude, new_results, run_command


def main(output: Out = Path("out/validation/cluster")):
    """Scaling of flights over workers: 1, 2 and 4 measured here, several hosts as network namespaces, 100 simulated."""
    with new_results(output) as (report, folder):
        record = study.run(folder, progress=report)
    conclude("cluster", output, study.HEADER, study.rows(record))


if __name__ == "__main__":
    run_command(main)
