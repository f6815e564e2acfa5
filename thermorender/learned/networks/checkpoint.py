"""The state of a training in one file of safetensors, which holds numbers and text and nothing that runs."""

import json

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from thermorender import files, formats
from thermorender.errors import ThermorenderError


def save(path, learner, facts):
    """Write all networks and optimisers of a Learner, and facts (plain values), all or nothing."""
    tensors, groups = {}, {}
    for name, part in learner.parts.items():
        for key, value in part.state_dict().items():
            tensors[f"net/{name}/{key}"] = value.detach().cpu().contiguous()
    for name, optimiser in learner.optimisers.items():
        kept = optimiser.state_dict()
        for index, values in kept["state"].items():
            for key, value in values.items():
                tensors[f"optimiser/{name}/{index}/{key}"] = torch.as_tensor(value).cpu().contiguous()
        groups[name] = [{k: v for k, v in group.items() if k != "params"} for group in kept["param_groups"]]
    told = {"facts": json.dumps(facts), "groups": json.dumps(groups)}
    with files.atomic(path) as part:
        try:
            save_file(tensors, part, told | {"checksum": _checksum(told, tensors)})
        except SafetensorError as error:
            raise OSError(str(error)) from error
    files.on_disk(path)


def load(path, learner):
    """Bring a Learner to the state of a file; return its facts.

    Raises
    ------
    ThermorenderError
        A file that is missing, damaged or of another training.
    """
    try:
        with safe_open(path, framework="pt") as file:
            told = file.metadata()
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        # Weights of which a bit fell over are as good numbers as any.
        if told.pop("checksum") != _checksum(told, tensors):
            raise ValueError("its bytes are not those that were written")
        facts, groups = json.loads(told["facts"]), json.loads(told["groups"])
        for name, part in learner.parts.items():
            start = f"net/{name}/"
            part.load_state_dict({key.removeprefix(start): v for key, v in tensors.items() if key.startswith(start)})
        for name, optimiser in learner.optimisers.items():
            state = {}
            for key, value in tensors.items():
                kind, _, rest = key.partition("/")
                if kind == "optimiser" and rest.startswith(f"{name}/"):
                    _, index, what = rest.split("/")
                    state.setdefault(int(index), {})[what] = value
            own = optimiser.state_dict()["param_groups"]
            kept = [{**group, "params": mine["params"]} for group, mine in zip(groups[name], own, strict=True)]
            optimiser.load_state_dict({"state": state, "param_groups": kept})
    # What is damaged or of another training shows in the parsers of safetensors, JSON and PyTorch.
    except Exception as error:
        raise ThermorenderError(
            f"{path} is no checkpoint of this training ({' '.join(str(error).split())[:200]}); begin anew in another "
            "--run folder"
        ) from None
    return facts


def _checksum(told, tensors):
    return formats.digest(sorted(told.items()), {name: tensors[name].numpy() for name in sorted(tensors)})
