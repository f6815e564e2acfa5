"""All verbs alike: what their help says."""

import re
import sys

import pytest
import typer

from thermorender import cli


def verbs(command=None, path=()):
    """{words of the command line: click command} of every verb."""
    command = typer.main.get_command(cli.app) if command is None else command
    if not hasattr(command, "commands"):
        return {path: command}
    below = (verbs(each, (*path, name)) for name, each in command.commands.items())
    return {words: verb for found in below for words, verb in found.items()}


VERBS = verbs()


def with_option(name):
    return {words for words, verb in VERBS.items() for parameter in verb.params if name in parameter.opts}


@pytest.fixture
def call(monkeypatch, capfd):
    """Run the command line in this process; return (status, output, errors)."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["thermorender", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as exit:
            cli.main()
        return exit.value.code, *capfd.readouterr()

    return run


def test_the_walk_finds_every_verb():
    assert {("render",), ("fly",), ("train", "emissivity"), ("validate", "air"), ("materials", "merge")} <= set(VERBS)
    assert with_option("--trajectory") == with_option("--duplicates") >= {("fly",), ("compare",)}


@pytest.mark.parametrize("words", VERBS, ids=" ".join)
def test_help_says_the_units(words, call):
    status, output, errors = call(*words, "--help")
    assert (status, errors) == (0, "")
    # Whatever the width of the terminal and the frame around it, the help is there word by word, its units too.
    shown = "".join(re.sub(r"[│╭╮╰╯─]", " ", output).split())
    verb = VERBS[words]
    for text in (verb.help, *(parameter.help for parameter in verb.params if getattr(parameter, "help", None))):
        assert "".join(text.split()) in shown


def test_some_help_has_units():
    texts = [parameter.help or "" for verb in VERBS.values() for parameter in verb.params if hasattr(parameter, "help")]
    units = {unit for text in texts for unit in re.findall(r"\[[^\]]+\]", text)}
    assert {"[m]", "[s]", "[deg]", "[mK]", "[K]", "[µm]"} <= units
