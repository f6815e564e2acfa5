"""Checkpoints: the state of a training in one safetensors file, which holds numbers and text but no code."""

import json
from collections.abc import Mapping
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from thermorender import files, formats
from thermorender.errors import ThermorenderError

# No optimisers.
_NONE: dict[str, torch.optim.Optimizer] = {}


def save(
    path: files.PathLike, nets: Mapping[str, nn.Module], facts: Mapping[str, Any],
    optimisers: Mapping[str, torch.optim.Optimizer] = _NONE,
) -> None:  # fmt: skip
    """Write networks and optimisers by name, and facts (plain values), atomically."""
    tensors, groups = {}, {}
    for name, net in nets.items():
        for key, value in net.state_dict().items():
            tensors[f"net/{name}/{key}"] = value.detach().cpu().contiguous()
    for name, optimiser in optimisers.items():
        kept = optimiser.state_dict()
        for index, values in kept["state"].items():
            for key, value in values.items():
                tensors[f"optimiser/{name}/{index}/{key}"] = torch.as_tensor(value).cpu().contiguous()
        groups[name] = [{k: v for k, v in group.items() if k != "params"} for group in kept["param_groups"]]
    texts = {"facts": json.dumps(facts), "groups": json.dumps(groups)}
    with files.atomic(path) as part:
        try:
            save_file(tensors, part, texts | {"checksum": _checksum(texts, tensors)})
        except SafetensorError as error:
            raise OSError(str(error)) from error
    files.on_disk(path)


def load(
    path: files.PathLike, nets: Mapping[str, nn.Module], optimisers: Mapping[str, torch.optim.Optimizer] = _NONE
) -> dict[str, Any]:
    """Restore networks and optimisers from a file and return the file's facts."""
    try:
        with safe_open(path, framework="pt") as file:
            texts = file.metadata()
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        # Weights with a flipped bit would pass as valid numbers.
        if texts.pop("checksum") != _checksum(texts, tensors):
            raise ValueError("its bytes are not those that were written")
        facts: dict[str, Any] = json.loads(texts["facts"])
        groups = json.loads(texts["groups"])
        for name, net in nets.items():
            start = f"net/{name}/"
            net.load_state_dict({key.removeprefix(start): v for key, v in tensors.items() if key.startswith(start)})
        for name, optimiser in optimisers.items():
            state: dict[int, dict[str, torch.Tensor]] = {}
            for key, value in tensors.items():
                kind, _, rest = key.partition("/")
                if kind == "optimiser" and rest.startswith(f"{name}/"):
                    _, index, what = rest.split("/")
                    state.setdefault(int(index), {})[what] = value
            own = optimiser.state_dict()["param_groups"]
            kept = [{**group, "params": mine["params"]} for group, mine in zip(groups[name], own, strict=True)]
            optimiser.load_state_dict({"state": state, "param_groups": kept})
    # A wrong file can raise many kinds of errors in safetensors, JSON and PyTorch.
    except Exception as error:
        raise ThermorenderError(
            f"{path} is not a checkpoint of this training ({' '.join(str(error).split())[:200]}); start again in "
            "another --run folder"
        ) from None
    return facts


def _checksum(texts: Mapping[str, str], tensors: Mapping[str, torch.Tensor]) -> str:
    """Checksum of a file's texts and tensors."""
    return formats.digest(sorted(texts.items()), {name: tensors[name].numpy() for name in sorted(tensors)})
