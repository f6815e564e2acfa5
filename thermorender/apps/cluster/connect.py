"""Where the workers are: local processes, a scheduler by its address, or a Dask configuration that names one."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from thermorender.errors import ThermorenderError

if TYPE_CHECKING:
    from distributed import Client

# How long a scheduler may take to answer [s].
ANSWER_S = 20.0


@dataclass(frozen=True)
class Address:
    """Where the workers are."""

    local: int = 0  # Processes to start on this machine; 0: none
    scheduler: str | None = None  # Address of a scheduler
    # A Dask configuration (YAML) with `scheduler-address`, and the certificates of `distributed.comm.tls` if needed
    config: Path | None = None


def parse_cluster(text: str) -> Address:
    """Return the Address of a text such as local:2, tcp://scheduler:8786 or a file's name."""
    if match := re.fullmatch(r"local:([1-9]\d{0,3})", text):
        return Address(local=int(match[1]))
    if re.fullmatch(r"(tcp|tls)://[^/\s]+:\d+", text):
        return Address(scheduler=text)
    if os.path.isfile(text):
        return Address(config=Path(text))
    raise ThermorenderError(
        f"cluster={text!r} is not allowed; give local:N with a number of processes, the address of a scheduler such "
        "as tcp://scheduler:8786, or the file of a Dask configuration with scheduler-address"
    )


@contextmanager
def connected(address: Address) -> Iterator["Client"]:
    """Yield a Dask client; local processes end with the block."""
    try:
        import dask
        from distributed import Client
    except ImportError:
        raise ThermorenderError(
            "a cluster needs Dask, which is not installed; add it with `pip install 'thermorender[cluster]'`"
        ) from None
    if address.local:
        from thermorender.apps.cluster.local import local_cluster

        with local_cluster(address.local) as cluster, Client(cluster, set_as_default=False) as client:
            yield client
        return
    given = _read_config(address.config) if address.config else {"scheduler-address": address.scheduler}
    with dask.config.set(given):
        scheduler = dask.config.get("scheduler-address")
        try:
            client = Client(timeout=ANSWER_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError, TypeError) as error:
            raise ThermorenderError(
                f"no scheduler answers at {scheduler} ({str(error).splitlines()[0] or type(error).__name__}); start it "
                "with `dask scheduler` and give its address as cluster"
            ) from None
        with client:
            yield client


def _read_config(path: Path) -> dict[str, object]:
    """The values of a Dask configuration, with its address."""
    from dask.config import collect_yaml

    try:
        (found,) = collect_yaml([str(path)])
    except ValueError:
        raise ThermorenderError(
            f"{path} is not a Dask configuration in YAML; give one with scheduler-address"
        ) from None
    if not isinstance(found, dict) or not isinstance(found.get("scheduler-address"), str):
        raise ThermorenderError(
            f"{path} has no scheduler-address; add a line such as scheduler-address: tcp://scheduler:8786"
        )
    return found
