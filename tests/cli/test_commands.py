"""Commands are found by name as other plugins are: the bundled ones and a stranger's keep one contract."""

from __future__ import annotations

import subprocess
import sys
from typing import Annotated, Any

import pytest

from bidnerf.cli import COMMANDS, Json, Option, print_json, show
from bidnerf.testing import CommandContract
from bidnerf_core.registry import list_plugins, register, registered
from commands import Run, assert_refused


def greet(name: Annotated[str, Option("NAME", "who is greeted", positional=True)], json: Json = False) -> None:
    """Greet somebody.

    Politely.
    """
    if json:
        print_json({"greeted": name})
    else:
        show(f"hello, {name}")


def rude(name: str, json: Json = False) -> None:
    """Greet nobody."""
    print("nobody") if json else sys.exit(int(name))


@pytest.fixture(autouse=True)
def _greetings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bidnerf_core.registry.registered", dict(registered))
    register("commands", "greet", greet)
    register("commands", "rude", rude)


class TestGreet(CommandContract):
    name, arguments = "greet", ("world",)


class TestPlugins(CommandContract):
    name, arguments = "plugins", ("commands",)


def test_a_registered_command_is_run_and_listed(bidnerf: Run) -> None:
    assert bidnerf("greet", "world") == (0, "hello, world\n", "")
    assert "  greet " in bidnerf("--help").out
    assert [info.summary for info in list_plugins("commands") if info.name == "greet"] == ["Greet somebody."]
    assert bidnerf("gret").err.startswith("bidnerf: no command 'gret', did you mean 'greet'?")


@pytest.mark.parametrize(
    ("test", "arguments", "fault"),
    [
        ("test_help_describes_every_argument", None, "does not describe --name"),
        ("test_it_succeeds_and_prints_json_if_asked", ("--name", "3"), "exit status 3"),
        ("test_it_succeeds_and_prints_json_if_asked", ("--name", "0"), "'nobody' is not JSON"),
    ],
)
def test_the_contract_finds_what_is_wrong(test: str, arguments: Any, fault: str) -> None:
    contract = CommandContract()
    contract.name, contract.arguments = "rude", arguments  # type: ignore[misc]
    with pytest.raises(AssertionError, match=fault):
        getattr(contract, test)()


@pytest.mark.parametrize(
    ("command", "fault"), [("text", "it is a str"), (lambda: None, "no docstring"), (int, "it is a type")]
)
def test_what_is_no_command_is_refused(bidnerf: Run, command: Any, fault: str) -> None:
    register("commands", "broken", command)
    assert_refused(bidnerf("broken"), 1, "not a command", fault)


def test_listing_imports_no_command() -> None:
    """Every bundled command has a summary of its own, which is read without importing it."""
    program = "import sys; from bidnerf.cli import main; main(['--help']); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    *page, modules = done.stdout.splitlines()
    for info in list_plugins("commands"):
        if info.is_bundled:
            (line,) = [line for line in page if line.split()[:1] == [info.name]]
            assert line.split(maxsplit=1)[1] == (COMMANDS[info.name].__doc__ or "").split("\n")[0]
            assert len(line) <= 80
            assert info.value.partition(":")[0] not in modules.split()
    assert not {"torch", "rich", "pydantic"} & set(modules.split())
