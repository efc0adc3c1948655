"""The documentation agrees with the code: commands, links, figures, columns, recipe keys; see also `test_examples`."""

import ast
import importlib.util
import inspect
import json
import re
import shlex
import subprocess
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, get_args, get_type_hints

import pytest
import yaml
from testing.projects import project_of
from typer.main import get_command

from pisigma.cli.main import app
from pisigma.lifetime.cell.status import State
from pisigma.measurement.csv.columns import column_choices, find_column
from pisigma.planning.surroundings.surroundings import Surroundings, read_surroundings
from pisigma.robot import Robot, catalogue
from pisigma.robot.kinematics.status import Status

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
LARGEST_FIGURE = 150_000
"""Maximum size of a figure [bytes]."""


def _name(page: Path) -> str:
    return page.relative_to(DOCS).as_posix()


def _text(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def _without_blocks(text: str) -> str:
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def _hook(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / "hooks" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _command_lines() -> list[tuple[str, tuple[str, ...]]]:
    """Return every line of a bash block that calls pisigma, as words; text after `||` or `&&` is ignored."""
    found = []
    for page in PAGES:
        for block in re.findall(r"^```bash\n(.*?)^```", _text(page), flags=re.MULTILINE | re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                if words[:1] == ["pisigma"]:
                    end = next((i for i, word in enumerate(words) if word in ("||", "&&", "|", ";")), None)
                    found.append((_name(page), _grouped(words[1:end])))
    return found


def _grouped(words: list[str]) -> tuple[str, ...]:
    """Return the words of a call, with a command of a group, such as `fleet run`, as one word."""
    return (" ".join(words[:2]), *words[2:]) if words[0] in GROUPS else tuple(words)


TOP = get_command(app).commands  # type: ignore[attr-defined]
GROUPS = {name for name, command in TOP.items() if hasattr(command, "commands")}
COMMANDS = {name: command for name, command in TOP.items() if name not in GROUPS}
COMMANDS |= {f"{group} {name}": one for group in GROUPS for name, one in TOP[group].commands.items()}


@pytest.mark.parametrize(("page", "words"), _command_lines(), ids=lambda value: str(value)[:60])
def test_a_command_line_is_understood(page: str, words: tuple[str, ...]) -> None:
    assert words[0] in COMMANDS, f"{page}: there is no command {words[0]}"
    context = COMMANDS[words[0]].make_context(words[0], list(words[1:]))
    assert context.params


def test_the_forms_of_export_exist_and_are_all_shown() -> None:
    (described,) = (p.help for p in COMMANDS["export"].params if p.name == "form")
    shown = {
        words[words.index("--format") + 1]
        for _, words in _command_lines()
        if "--format" in words and "--plugin" not in words
    }
    assert shown == set(re.findall(r"(?:^|; )([\w-]+):", described))


def test_every_command_is_documented() -> None:
    assert {words[0] for _, words in _command_lines()} == set(COMMANDS)


def test_commands_and_options_within_sentences_exist() -> None:
    looked_at = 0
    every = {
        option for command in COMMANDS.values() for parameter in command.params for option in parameter.opts
    }
    every |= {option for c in COMMANDS.values() for p in c.params for option in p.secondary_opts} | {"--help"}
    for page in PAGES:
        for span in re.findall(r"`([^`\n]+)`", _without_blocks(_text(page))):
            words = span.split()
            if words[0] == "pisigma" and len(words) > 1:
                looked_at += 1
                name, *others = _grouped(words[1:])
                assert name in COMMANDS, f"{_name(page)}: there is no command in `{span}`"
                own = {o for p in COMMANDS[name].params for o in (*p.opts, *p.secondary_opts)}
                for word in others:
                    assert not word.startswith("--") or word in own, f"{_name(page)}: `{span}`"
            elif words[0].startswith("--"):
                looked_at += 1
                assert words[0] in every, f"{_name(page)}: there is no option in `{span}`"
    assert looked_at > 20


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_python_blocks_are_python(page: Path) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", _text(page), flags=re.MULTILINE | re.DOTALL)
    for block in blocks:
        compile(block, _name(page), "exec")


def _called(call: ast.expr, names: dict[str, object]) -> Any:
    """Return the function or class that an expression calls, or None if it is not one that `names` lead to."""
    path = ast.unparse(call.func).split(".") if isinstance(call, ast.Call) else [""]
    found = names.get(path[0])
    for name in path[1:]:
        found = getattr(found, name, None)
    return found if callable(found) else None


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_python_blocks_name_arguments_and_fields_that_exist(page: Path) -> None:
    """Check keyword arguments of functions of pisigma, and fields of the dataclasses that these return."""
    blocks = re.findall(r"^```python\n(.*?)^```", _text(page), flags=re.MULTILINE | re.DOTALL)
    nodes = [node for block in blocks for node in ast.walk(ast.parse(block))]
    names, results = dict[str, object](), dict[str, Any]()
    for node in nodes:
        if isinstance(node, ast.Import | ast.ImportFrom) and "pisigma" in (text := ast.unparse(node)):
            exec(text, names)
    for node in nodes:
        if called := _called(node, names) if isinstance(node, ast.Call) else None:
            stated = {word.arg: None for word in node.keywords if word.arg}
            inspect.signature(called).bind_partial(**stated)
        if isinstance(node, ast.Assign) and (called := _called(node.value, names)):
            result = called if isinstance(called, type) else get_type_hints(called).get("return")
            results |= {ast.unparse(target): result for target in node.targets if is_dataclass(result)}
    for node in nodes:
        if isinstance(node, ast.Attribute) and (result := results.get(ast.unparse(node.value))):
            assert node.attr in {*dir(result), *(one.name for one in fields(result))}, ast.unparse(node)


def _anchors(page: Path) -> set[str]:
    """Return the anchors that Python-Markdown makes of headings."""
    found = set()
    for title in re.findall(r"^#+ (.+)$", _without_blocks(_text(page)), flags=re.MULTILINE):
        plain = re.sub(r"[^\w\s-]", "", title.replace("`", "")).strip().lower()
        found.add(re.sub(r"[-\s]+", "-", plain))
    return found


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_have_a_target(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", _without_blocks(_text(page))):
        file, _, anchor = target.partition("#")
        other = (page.parent / file).resolve() if file else page
        assert other.is_file(), f"{_name(page)}: {target}"
        assert DOCS in other.parents, f"{_name(page)}: {target} leads out of the documentation"
        if anchor and anchor not in ("only-light", "only-dark"):  # schemes of pictures
            assert anchor in _anchors(other), f"{_name(page)}: {target}"


def _entries(nav: object) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    inner = nav.values() if isinstance(nav, dict) else nav
    return [entry for part in inner for entry in _entries(part)]  # type: ignore[attr-defined]


def test_navigation_contains_every_page_once() -> None:
    stated = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    entries = _entries(stated["nav"])
    assert sorted(entries) == sorted(_name(page) for page in PAGES)
    assert set(entries) - {"index.md"} <= set(re.findall(r"\(([\w/-]+\.md)", _text(DOCS / "index.md")))


def test_figures_are_small_used_and_shown_with_their_command() -> None:
    shown = set()
    for page in PAGES:
        text = _without_blocks(_text(page))
        parts = text.split("\n\n")
        for number, part in enumerate(parts):
            for figure in re.findall(r"!\[[^\]]+\]\(([^)#]+)[^)]*\)", part):
                path = (page.parent / figure).resolve()
                shown.add(path)
                assert path.stat().st_size <= LARGEST_FIGURE, figure
                command = (
                    text if "figures/tour/" in figure else part + parts[number + 1]
                )  # one command takes all
                assert "`" in command, f"{_name(page)}: {figure} has no command"
    files = (DOCS / "figures").rglob("*")
    assert shown == {path.resolve() for path in files if path.suffix in (".png", ".webp")}


def test_pages_need_no_network_and_name_no_machine() -> None:
    for path in [*PAGES, *DOCS.rglob("*.py"), *DOCS.rglob("*.css"), ROOT / "mkdocs.yml"]:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"https?://|\bwww\.", text), path
        assert not re.search(r"(?<![\w.])/(work|root|home|tmp|opt)/", text), path


def test_the_table_of_columns_is_that_of_the_reader() -> None:
    text = _text(DOCS / "reference" / "measurement-files.md")
    table = text.split("## Columns", 1)[1].split("\n\n")[1].splitlines()[2:]
    named = {name for row in table for name in re.findall(r"`([^`]+)`", row.split("|")[1])}
    joints = {name for name in named if re.match(r"q\d", name)}
    assert joints == {"q1_deg", "q1_rad", "q2_...", "q3_mm", "q3_m"}
    assert all(find_column(name) for name in joints - {"q2_..."})
    valid = column_choices("nothing").split("Valid: ", 1)[1].rstrip(".").split(", ")
    assert named - joints == {name for name in valid if not re.match(r"q\d", name)}


def test_the_example_cells_show_every_key(tmp_path: Path) -> None:
    blocks = re.findall(r"^```yaml\n(.*?)^```", _text(DOCS / "how-to" / "plan.md"), re.MULTILINE | re.DOTALL)
    shown: set[str] = set()
    for block in blocks:
        (tmp_path / "cell.yaml").write_text(block, encoding="utf-8")
        cell = read_surroundings(tmp_path / "cell.yaml", Robot.load("ur10"))
        shown |= set(cell.model_dump(exclude_defaults=True))
    assert shown == set(Surroundings.model_fields), "the examples show everything"


def test_the_keys_of_recipes_are_those_of_the_models() -> None:
    tables = _hook("recipe_tables")
    text = _text(DOCS / "reference" / "recipes.md")
    assert tables.page_with(text, tables.tables()) == text, "run: python docs/hooks/recipe_tables.py"


@pytest.mark.parametrize(("page", "hook"), [("settings", "setting_tables"), ("history", "history_tables")])
def test_tables_are_those_of_the_classes(monkeypatch: pytest.MonkeyPatch, page: str, hook: str) -> None:
    monkeypatch.syspath_prepend(DOCS / "hooks")
    tables = _hook(hook)
    text = _text(DOCS / "reference" / f"{page}.md")
    assert tables.page_with(text, tables.tables()) == text, f"run: python docs/hooks/{hook}.py"


def test_the_licence_of_every_dependency_is_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of other versions may have other dependencies, so only the stated ones are compared."""
    monkeypatch.syspath_prepend(DOCS / "hooks")
    licences = _hook("licence_table")
    page = _text(DOCS / "reference" / "dependencies.md")
    named = dict(re.findall(r"^\| ([\w-]+) \| ([^|]+) \|", page, flags=re.MULTILINE))
    for project in licences.PROJECTS.values():
        stated = project_of(project.parent)["dependencies"]
        assert {re.split("[<>=]", one)[0] for one in stated} <= set(named)
    assert named["numpy"].startswith("BSD-3-Clause")


def test_the_table_of_states_has_every_state_of_a_cell() -> None:
    table = _text(DOCS / "how-to" / "cell.md").split("## States", 1)[1].split("\n## ", 1)[0]
    assert sorted(re.findall(r"^\| `(\w+)` \|", table, flags=re.MULTILINE)) == sorted(get_args(State))


def test_every_status_and_every_robot_is_named() -> None:
    statuses = re.findall(
        r"^\| `([A-Z_]+)` \|", _text(DOCS / "how-to" / "corrected-ik.md"), flags=re.MULTILINE
    )
    assert set(statuses) == {status.name for status in Status}
    robots = _text(DOCS / "how-to" / "add-a-robot.md")
    assert all(f"`{name}`" in robots for name in catalogue())


def test_published_figures_agree_with_the_runs() -> None:
    page, readme = (
        _text(DOCS / "how-to" / "choose-a-model.md"),
        (ROOT / "README.md").read_text(encoding="utf-8"),
    )
    results = _text(DOCS / "explanation" / "results.md")
    for robot in ("UR5", "UR10", "FANUC", "Franka"):
        (ours,) = re.findall(rf"^\| {robot}\b.*$", page, flags=re.MULTILINE)
        for text in (readme, results):
            (theirs,) = re.findall(rf"^\| {robot}\b.*$", text, flags=re.MULTILINE)
            assert ours.split("|")[2:] == theirs.split("|")[2:]
    curve = json.loads((ROOT / "training" / "results" / "ur10_hybrid.json").read_text())["learning_curve"]
    rows = {
        int(row[0]): (float(row[1]), float(row[2]))
        for row in re.findall(r"^\| (\d+) \| (\d\.\d+) \| (\d\.\d+) \|$", page, flags=re.MULTILINE)
    }
    found = {p["rows"]: tuple(round(p[kind]["rms_mm"], 3) for kind in ("geometric", "hybrid")) for p in curve}
    assert rows == found


FORMULAS = [
    formula
    for page in PAGES
    for formula in re.findall(r"\\\((.+?)\\\)|\\\[(.+?)\\\]", _without_blocks(_text(page)), flags=re.DOTALL)
]


def test_every_formula_becomes_mathml() -> None:
    pytest.importorskip("latex2mathml", reason="the extra docs is not installed")
    hook = _hook("mathml")
    assert len(FORMULAS) > 50
    for inline, block in FORMULAS:
        tag, text = ("span", rf"\({inline}\)") if inline else ("div", rf"\[{block}\]")
        made = hook.on_page_content(f'<{tag} class="arithmatex">{text}</{tag}>')
        assert "<math" in made
        assert "\\" not in made, inline or block


def test_the_pages_build_without_a_warning_and_fetch_nothing(tmp_path: Path) -> None:
    for name in ("mkdocs", "material", "mkdocstrings", "latex2mathml"):
        pytest.importorskip(name, reason="the extra docs is not installed")
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--quiet",
        "--site-dir",
        str(tmp_path / "site"),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > len(PAGES)
    for page in pages:
        html = page.read_text(encoding="utf-8")
        assert not re.search(r"<(script|link|img|iframe)\b[^>]*(src|href)=\"?https?:", html), page
        assert "arithmatex" not in html, page
