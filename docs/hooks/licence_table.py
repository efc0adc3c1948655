"""Licences of all required packages: `python docs/hooks/licence_table.py` writes them into the page on dependencies."""

import re
from importlib.metadata import Distribution, distribution
from pathlib import Path

import tomllib
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "dependencies.md"
PROJECTS = {
    "pisigma": ROOT / "pyproject.toml",
    "pisigma-ik": ROOT / "packaging" / "pisigma-ik" / "pyproject.toml",
}
FROM_CLASSIFIERS = {
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD-3-Clause",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Python Software Foundation License": "matplotlib (based on PSF-2.0)",
}
"""Licences by the classifiers of packages that state no SPDX expression."""


def required(project: Path) -> dict[str, Distribution]:
    """Return the installed distributions that a project requires, also those that its requirements require."""
    stated = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["dependencies"]
    found: dict[str, Distribution] = {}
    wanted = [Requirement(one) for one in stated]
    while wanted:
        one = wanted.pop()
        name = re.sub(r"[-_.]+", "-", one.name).lower()
        if name not in found and (one.marker is None or one.marker.evaluate({"extra": ""})):
            found[name] = distribution(one.name)
            wanted += map(Requirement, found[name].requires or ())
    return found


def licence_of(package: Distribution) -> str:
    """Return the licence from the metadata: the SPDX expression, otherwise the classifier or a short field."""
    metadata = package.metadata
    if expression := metadata.get("License-Expression"):
        return str(expression)
    for classifier in metadata.get_all("Classifier") or ():
        if classifier.startswith("License ::"):
            return FROM_CLASSIFIERS[classifier.rpartition(" :: ")[2]]
    return str(metadata.get("License", "")).splitlines()[0]


def table() -> str:
    """Return the table of packages, licences and whether pisigma-ik requires them."""
    all_packages, small = (required(project) for project in PROJECTS.values())
    rows = [
        f"| {name} | {licence_of(one)} | {'yes' if name in small else ''} |"
        for name, one in sorted((all_packages | small).items())
    ]
    return "\n".join(["| package | licence | of pisigma-ik |", "|---|---|---|", *rows])


if __name__ == "__main__":
    head, _, _ = PAGE.read_text(encoding="utf-8").partition("| package |")
    PAGE.write_text(head + table() + "\n", encoding="utf-8")
