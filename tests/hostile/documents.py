"""Hostile YAML documents: robots and recipes with wrong values at random places, and malicious YAML."""

import copy
from pathlib import Path
from typing import Any

import yaml
from hostile.case import Case, Rng, calibrate, one_of
from hostile.clean import Clean
from hostile.damage import TEXTS, damaged

VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 1e300, -1e300, 1e-320, 1e9, 10**9, 2**63, 10**400, float("inf"), float("nan"),
    -0.0, 1e12, [], {}, [[]], [0], [1, 2, 3], [None], {"a": 1}, {"kind": "x"}, list(range(3000)),
    {str(i): i for i in range(3000)}, "1", "1e3", *TEXTS,
)  # fmt: skip
Place = tuple[Any, Any]
"""A mapping or a list, and a key of it."""

BOMBS = (
    "a: &a [x, x, x, x, x, x, x, x, x]\n"
    + "".join(
        f"{c}: &{c} [{', '.join([f'*{b}'] * 9)}]\n" for b, c in zip("abcdefgh", "bcdefghi", strict=True)
    ),
    "a: &a\n  b: *a\n",
    "[" * 5000 + "]" * 5000,
    "{a: " * 3000 + "1" + "}" * 3000,
    "!!python/object/apply:os.system ['echo harm']\n",
    "name: !!binary aGFybQ==\n",
    "name: !!set {a, b}\n",
    "a: 1\n---\nb: 2\n",
    "? [a, b]\n: c\n",
    "<<: &m {name: x}\nrows: *m\n",
    "%YAML 9.9\n---\nname: x\n",
    "name: [unclosed\n",
    "name: 'unclosed\n",
    "- name\n- rows\n",
    "just a text\n",
    "name: 2026-11-22\n",
    "1: 2\n",
    "\tname: x\n",
    "name: x\nname: y\n",
    "rows: &r [" + ",".join(["{name: a, type: revolute}"] * 2000) + "]\n",
)


def places(node: Any) -> list[Place]:
    """Return the places of all values of a document."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [place for key, value in items for place in ((node, key), *places(value))]


def mutated(rng: Rng, document: Any, times: int = 1) -> tuple[str, Any]:
    """Change a document at a random place, and return it with a description of the change."""
    document, done = copy.deepcopy(document), []
    for _ in range(times):
        node, key = one_of(rng, places(document) or [({"": 0}, "")])
        how = one_of(
            rng, ("value", "value", "value", "scaled", "gone", "renamed", "wrapped", "exchanged", "repeated")
        )
        done.append(f"{key}: {how}")
        if how == "gone":
            del node[key]
        elif how == "scaled" and isinstance(node[key], int | float):
            node[key] *= one_of(rng, (-1, 10, 1e-3, 1e3, 1e6, 1.01, 1e8))
        elif how == "renamed" and isinstance(node, dict):
            node[one_of(rng, (key + "s", key.upper(), "", "x" * 5000, "\x1b[31m"))] = node.pop(key)
        elif how == "wrapped":
            node[key] = one_of(rng, ([node[key]], {"value": node[key]}, [node[key]] * 100))
        elif how == "exchanged":
            other, at = one_of(rng, places(document))
            node[key], other[at] = copy.deepcopy(other[at]), copy.deepcopy(node[key])
        elif how == "repeated" and isinstance(node, list):
            node.extend([copy.deepcopy(node[key])] * one_of(rng, (1, 20, 300)))
        else:
            node[key] = one_of(rng, VALUES)
            done[-1] = f"{key}: {str(node[key])[:20]!r}"
    return ", ".join(done), document


def written(rng: Rng, path: Path) -> tuple[str, bytes]:
    """Write a YAML file that is damaged as text, changed as a document, or malicious."""
    content, draw = path.read_bytes(), rng.random()
    if draw < 0.25:
        return damaged(rng, content)
    if draw < 0.35:
        index = int(rng.integers(len(BOMBS)))
        text = BOMBS[index]
        return f"bomb {index}", (text if rng.random() < 0.5 else content.decode() + text).encode()
    what, document = mutated(rng, yaml.load(content, Loader=yaml.CSafeLoader), one_of(rng, (1, 1, 2)))
    text = yaml.dump(
        document, Dumper=yaml.CSafeDumper, sort_keys=False, allow_unicode=bool(rng.random() < 0.5)
    )
    return what, text.encode("utf-8", errors="replace")


def wrong_robot(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write a wrong robot file in YAML."""
    path = one_of(rng, list(clean.robots))
    what, content = written(rng, path)
    (folder / "robot.yaml").write_bytes(content)
    name = clean.robots[path]
    return Case(f"{path.stem}: {what}", calibrate("robot.yaml", str(clean.rows[name].path)), clean.rows[name])


def robot_file_case(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write a robot with random rows: one joint or 20, prismatic only, without lengths, with limits reversed."""
    count = one_of(rng, (1, 2, 3, 6, 7, 12, 20, 400))
    rows: list[dict[str, Any]] = []
    kinds = one_of(rng, (("revolute",), ("prismatic",), ("fixed",), ("revolute", "prismatic", "fixed")))
    length = one_of(rng, (0.0, 1.0, 100.0, 1e5, 1e12, 1e-9))
    for number in range(count):
        kind = one_of(rng, kinds)
        row: dict[str, Any] = {"name": f"j{number}", "type": kind, "d_mm": length * float(rng.normal())}
        row |= {"a_mm": length * float(rng.normal()), "alpha_deg": one_of(rng, (0, 90, -90, 33.3, 1e6))}
        if kind != "fixed" and rng.random() < 0.5:
            limits = one_of(rng, ([-180, 180], [180, -180], [0, 0], [1e-9, 2e-9], [-1e9, 1e9]))
            row["limits_deg" if kind == "revolute" else "limits_mm"] = limits
        rows.append(row)
    text = yaml.safe_dump({"name": "drawn", "maker": "", "source": "", "rows": rows})
    (folder / "robot.yaml").write_text(text, encoding="utf-8")
    moving = [row for row in rows if row["type"] != "fixed"]
    units = ["deg" if row["type"] == "revolute" else "mm" for row in moving]
    header = ",".join([*(f"q{i}_{unit}" for i, unit in enumerate(units, 1)), "x_mm", "y_mm", "z_mm"])
    cells = rng.uniform(-90, 90, (one_of(rng, (1, 5, 60)), len(moving) + 3))
    lines = [header, *(",".join(f"{value:.6f}" for value in row) for row in cells)]
    (folder / "rows.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return Case(f"{count} rows, {'/'.join(kinds)}, {length:g} mm", calibrate("robot.yaml", "rows.csv"))


def wrong_recipe(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write a wrong recipe whose measurements are simulated."""
    path = one_of(rng, clean.recipes)
    what, content = written(rng, path)
    (folder / "recipe.yaml").write_bytes(content)
    return Case(f"{path.stem}: {what}", ("simulate", "recipe.yaml", "--out", "rows.csv"))
