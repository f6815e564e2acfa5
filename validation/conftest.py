"""The studies' tests use the fixtures of the other tests."""

from fixtures import _cache, _commands_built_once, call, call_module, run, short_heat  # noqa: F401
