"""A view and the chosen material in the address of the page, so that reload, Back and a bookmark bring them back."""

import contextlib
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

from thermorender.apps.studio.layers import layers_of
from thermorender.apps.studio.pictures import NAMES
from thermorender.apps.studio.view import Pose, View, limits_of, parsed_hour
from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import decimal

if TYPE_CHECKING:
    from thermorender import Scene

# Largest time of an address [s].
_LATEST_S = 1e6
# What a view may be compared with.
_AGAINST = re.compile(r"saved|version \d{1,6}|hour [\d.]{1,9}")


def query_of(view: View, scene: "Scene", material: str) -> str:
    """Return the query of an address that brings a view and a material back."""
    ends = ",".join("" if end is None else f"{end:.6g}" for end in view.limits) if view.limits else ""
    given = {
        "pose": view.pose.text(scene), "t": f"{view.time_s:g}" if view.time_s else "",
        "plan": "1" if view.plan else "", "show": view.layer, "against": view.against,
        "slider": "1" if view.slider else "", "palette": view.palette, "range": ends, "material": material,
    }  # fmt: skip
    return urlencode({key: value for key, value in given.items() if value}, safe=",")


def view_at(query: Mapping[str, str], scene: "Scene", first: View, learned: bool) -> View:
    """Return the View of an address; what it lacks or states wrongly is as in the view `first`. `learned` is whether
    the layers of a learned map are there.
    """
    made = replace(first, plan=query.get("plan") == "1", slider=query.get("slider") == "1")

    def state(change: Callable[[str], dict[str, Any]], key: str) -> None:
        nonlocal made
        if query.get(key):
            with contextlib.suppress(ThermorenderError, ValueError):
                made = replace(made, **change(query[key]))

    def known(key: str, names: Collection[str]) -> Callable[[str], dict[str, Any]]:
        return lambda text: {key: text} if text in names else {}

    state(lambda text: {"pose": Pose.typed(text, scene)}, "pose")
    state(lambda text: {"time_s": _time(text)}, "t")
    there = layers_of(scene, made.plan, learned)
    made = replace(made, layer=made.layer if made.layer in there else "kinetic")
    state(known("layer", there), "show")
    state(known("palette", NAMES), "palette")
    state(lambda text: {"limits": limits_of(*text.split(",", 1))} if "," in text else {}, "range")
    state(_against, "against")
    return made


def _against(text: str) -> dict[str, Any]:
    if not _AGAINST.fullmatch(text):
        return {}
    kind, _, hour = text.partition(" ")
    return {"against": f"hour {parsed_hour(hour):g}" if kind == "hour" else text}


def _time(text: str) -> float:
    value = decimal(text)
    if not 0.0 <= value <= _LATEST_S:
        raise ValueError(text)
    return value
