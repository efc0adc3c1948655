"""Templates: each can be read, and an undefined name is an error."""

import jinja2
import pytest

from pisigma.deployment.export.programs import languages
from pisigma.files.templates import template_environment
from pisigma.reporting import rendering

ENVIRONMENTS = {"reporting": rendering._environment(), "programs": languages._templates()}


@pytest.mark.parametrize(
    ("package", "name"),
    [
        (package, name)
        for package, environment in ENVIRONMENTS.items()
        for name in environment.list_templates()
    ],
)
def test_every_template_can_be_read(package, name):
    assert ENVIRONMENTS[package].get_template(name)


def test_undefined_names_are_errors():
    template = template_environment("pisigma.reporting", {}).from_string("{{ figure }}")
    assert template.render(figure="0.1 <mm>") == "0.1 <mm>"
    with pytest.raises(jinja2.UndefinedError, match="'figure' is undefined"):
        template.render()


def test_filters_are_available_in_templates():
    template = template_environment("pisigma.reporting", {"twice": lambda text: 2 * text}).from_string(
        "{{ 'ab' | twice }}"
    )
    assert template.render() == "abab"
