"""Values computed by functions whose parameters name their inputs, so signatures decide what an edit recomputes."""

from collections.abc import Callable, Iterable, Mapping
from inspect import signature
from typing import Any, NamedTuple, get_origin


class _Made(NamedTuple):
    value: Any
    used: Mapping[str, Any]  # {input: its value} of all inputs that the stage used


class Pipeline:
    """Stages: functions that return the value of their own name, from inputs and other stages.

    A parameter annotated as a callable without arguments is evaluated on demand, and is a dependency only if called.
    Lazy stages run when first asked for, the others at once, so that an edit with an invalid value is refused
    immediately.
    """

    def __init__(self, stages: Iterable[Callable[..., Any]], lazy: Iterable[Callable[..., Any]] = ()) -> None:
        stages, lazy = tuple(stages), tuple(lazy)
        self.functions = {stage.__name__: stage for stage in (*stages, *lazy)}
        self.eager = tuple(stage.__name__ for stage in stages)
        self.inputs = {name: dict(signature(stage).parameters) for name, stage in self.functions.items()}

    def parameters(self, stage: str) -> tuple[str, ...]:
        """Names of a stage's inputs."""
        return tuple(self.inputs[stage])


class Values:
    """Immutable inputs of a pipeline and the values of its stages.

    `earlier` are values before some inputs changed. A stage with the same inputs, or an equal result, keeps its old
    value.
    """

    def __init__(
        self, pipeline: Pipeline, inputs: Mapping[str, Any], earlier: "Values | None" = None,
        given: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        self._pipeline, self._inputs, self._made = pipeline, dict(inputs), dict[str, _Made]()
        self._earlier = dict(earlier._made) if earlier else {}
        for name, value in (given or {}).items():
            used = {each: self[each] for each in pipeline.parameters(name) if not self._deferred(name, each)}
            self._made[name] = _Made(value, used)
        for name in pipeline.eager:
            self[name]
        # Stages that ran on request keep their values too, without being run. Inputs precede what uses them.
        for name, made in self._earlier.items():
            if name not in self._made and all(
                (each in self._inputs or each in self._made) and same(self[each], value)
                for each, value in made.used.items()
            ):
                self._made[name] = made
        self._earlier = {}

    def edited(self, inputs: Mapping[str, Any], given: Mapping[str, Any] | None = None) -> "Values":
        """Values of other inputs; `given` replaces results of stages until an input of theirs changes."""
        return Values(self._pipeline, inputs, self, given)

    def __getitem__(self, name: str) -> Any:
        if name in self._inputs:
            return self._inputs[name]
        if name not in self._made:
            before = self._earlier.get(name)
            if before is None or not all(same(self[each], value) for each, value in before.used.items()):
                made = self._run(name)
                kept = before is not None and same(made.value, before.value)
                before = made._replace(value=before.value) if before is not None and kept else made
            self._made[name] = before
        return self._made[name].value

    def changes(self, other: "Values", stage: str) -> frozenset[str]:
        """Names of a stage's inputs that differ; one that it may not ask for is compared by its own inputs."""
        return frozenset(
            name for name in self._pipeline.parameters(stage)
            if not (self._alike(other, name) if self._deferred(stage, name) else same(self[name], other[name]))
        )  # fmt: skip

    def _alike(self, other: "Values", name: str) -> bool:
        """Whether a value is the same in both, by its inputs where it is not known in both."""
        if name in self._inputs or (name in self._made and name in other._made):
            return same(self[name], other[name])
        return all(self._alike(other, each) for each in self._pipeline.parameters(name))

    def _run(self, name: str) -> _Made:
        used, arguments = dict[str, Any](), dict[str, Any]()

        def ask(each: str) -> Any:
            used[each] = self[each]
            return used[each]

        for each in self._pipeline.parameters(name):
            arguments[each] = (lambda each=each: ask(each)) if self._deferred(name, each) else ask(each)
        return _Made(self._pipeline.functions[name](**arguments), used)

    def _deferred(self, stage: str, parameter: str) -> bool:
        return get_origin(self._pipeline.inputs[stage][parameter].annotation) is Callable


def same(one: Any, other: Any) -> bool:
    """Whether two values are the same: plain values by equality, arrays and what holds them by identity."""
    if one is other:
        return True
    try:
        return bool(one == other)
    except ValueError:  # of arrays
        return False
