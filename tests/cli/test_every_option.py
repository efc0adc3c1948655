"""Every option and key of `--set` is in a call of `tests/gate/options.txt`, with those that pages use together."""

import itertools
import os
import re
import shlex
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from click import Command, Context
from gate.option_inputs import copy_files
from gate.options import Call, calls, run_call
from testing.models import no_type_checker
from typer.main import get_command

from pisigma.cli.main import app

REPOSITORY = Path(__file__).parents[2]
ELSEWHERE = {("train", "--resume"): "tests/cli/test_train_interruption.py"} | dict.fromkeys(
    (("status", "--watch"), ("verify", "--model")),
    "tests/cli/test_cell_commands.py",
)
"""Options that need a test of their own, and where it is."""
OF_ALL_COMMANDS = ("--plugin", "--help-all")
"""Options that one command is enough to test."""
QUICK = ("robots --json", "import exports", "simulate rb5")
"""How calls begin that the suite runs too, in this process, so none with a plug-in."""
QUICK_CALLS = [
    call for call in calls() if shlex.join(call.words).startswith(QUICK) and "--plugin" not in call.words
]


def commands(command: Command, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Command]]:
    """All commands with their names, those of groups as `fleet run`."""
    if not hasattr(command, "commands"):
        yield " ".join(path), command
        return
    for name, one in command.commands.items():
        yield from commands(one, (*path, name))


COMMANDS = dict(commands(get_command(app)))


def stated(words: tuple[str, ...]) -> tuple[str, frozenset[str]]:
    """A call's command, and the options and keys that it states, as the command line itself reads it."""
    name = next(name for name in (" ".join(words[:2]), words[0]) if name in COMMANDS)
    context: Context = COMMANDS[name].make_context(
        name, list(words[len(name.split()) :]), resilient_parsing=False
    )
    found = set()
    for parameter in COMMANDS[name].params:
        given = context.get_parameter_source(str(parameter.name)).name == "COMMANDLINE"
        if parameter.param_type_name == "option" and given:
            off = parameter.secondary_opts and context.params.get(str(parameter.name)) is False
            found.add((parameter.secondary_opts if off else parameter.opts)[-1].replace("-y", "--yes"))
    keys = {one.partition("=")[0] for one in context.params.get("assignments") or ()}
    found |= {one.spelling for key, one in COMMANDS[name].keys.items() if key in keys}
    return name, frozenset(found)


@pytest.fixture(scope="module")
def ran() -> list[tuple[str, frozenset[str]]]:
    """What the calls of the table state, but for those that are refused on purpose."""
    return [stated(call.words) for call in calls() if call.status != 2]


def options() -> Iterator[tuple[str, str]]:
    for name, command in COMMANDS.items():
        for parameter in command.params:
            if parameter.param_type_name == "option":
                for option in (parameter.opts[-1], *parameter.secondary_opts):
                    yield name, option.replace("-y", "--yes") if option == "-y" else option
        yield from ((name, one.spelling) for one in command.keys.values())


def documented() -> Iterable[tuple[str, tuple[str, ...]]]:
    """Calls of bash blocks of README and docs: page, and words."""
    for page in (REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))):
        for block in re.findall(r"^```bash\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S):
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                if words[:1] == ["pisigma"]:
                    end = next((i for i, word in enumerate(words) if word in ("||", "&&", "|", ";")), None)
                    yield page.name, tuple(words[1:end])


def test_every_option_is_run(ran):
    seen = {(name, option) for name, used in ran for option in used}
    # --plugin and --help-all are options of all commands, which one mechanism each handles before the command starts
    missing = {one for one in options() if one[1] not in OF_ALL_COMMANDS} - seen - set(ELSEWHERE)
    assert not missing, f"add calls with them to tests/gate/options.txt: {sorted(missing)}"
    assert any("--plugin" in used for _, used in ran)
    for (name, option), file in ELSEWHERE.items():
        text = (REPOSITORY / file).read_text(encoding="utf-8")
        assert f'"{name}"' in text, file
        assert f'"{option}"' in text, file


def test_options_that_a_page_uses_together_are_run_together(ran):
    pairs = {(name, *pair) for name, used in ran for pair in itertools.combinations(sorted(used), 2)}
    missing = {}
    for page, words in documented():
        name, used = stated(words)
        for pair in itertools.combinations(sorted(used), 2):
            if (name, *pair) not in pairs:
                missing[(name, *pair)] = page
    assert not missing, f"add calls with both to tests/gate/options.txt: {missing}"


def test_every_format_that_a_page_exports_is_run():
    """As all share the options of `export`, the formats count as options."""

    def formats(all_words: Iterable[tuple[str, ...]]) -> set[str]:
        return {words[words.index("--format") + 1] for words in all_words if "--format" in words}

    assert formats(words for _, words in documented()) <= formats(call.words for call in calls())


@pytest.mark.parametrize("call", QUICK_CALLS, ids=lambda one: shlex.join(one.words))
def test_quick_calls_end_as_they_should(call: Call, inputs: Path):
    with no_type_checker():
        status, printed = run_call(call)
    assert status == call.status, printed


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder in which the calls run."""
    folder, before = tmp_path_factory.mktemp("options"), Path.cwd()
    copy_files(folder)
    os.chdir(folder)
    yield folder
    os.chdir(before)
