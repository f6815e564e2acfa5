"""Error toward the horizon by distance: `python -m validation.horizon`."""

from validation.command import Device, Out, new_results, run_command
from validation.horizon import study


def main(output: Out = "out/validation/horizon", device: Device = "auto"):
    """Error toward the horizon by distance, without far ground and with coarser posts."""
    from thermorender.cli.terminal import table

    with new_results(output) as (report, folder):
        cases = study.run(folder, progress=report, device=device)
    table(study.HEADER, study.rows(cases))


if __name__ == "__main__":
    run_command(main)
