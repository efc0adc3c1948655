"""Render texts from templates, which define the layout and wording of results that Python computes."""

from collections.abc import Callable
from typing import Any

import jinja2


def template_environment(package: str, filters: dict[str, Callable[..., Any]]) -> jinja2.Environment:
    """Return an environment that reads templates from the folder `templates` of a package.

    An undefined name is an error. Values in templates whose names end with .html.j2 are escaped.

    Args:
        package: name of the package, such as "pisigma.reporting".
        filters: functions that templates may call as filters, by name.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(package),
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= filters
    return environment
