"""Texts from templates: Python computes, a template holds layout and wording."""

from collections.abc import Callable
from typing import Any

import jinja2


def template_environment(package: str, filters: dict[str, Callable[..., Any]]) -> jinja2.Environment:
    """Read templates from the folder `templates` of a package; a name that nothing was filled in for is an error.

    Args:
        package: such as "pisigma.reporting".
        filters: functions that templates call, by name. What a template whose name ends with .html.j2 fills in shows
            as text, whatever it holds.
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
