"""Assertions of refusals: class and fields of an exception, never its message."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from click.testing import Result

from pisigma.files.errors import PisigmaError


@contextmanager
def refused(error: type[PisigmaError], **fields: Any) -> Iterator[pytest.ExceptionInfo[PisigmaError]]:
    """Assert that the block raises `error` with these fields.

    Args:
        error: the class of the exception.
        **fields: attributes of the exception (`file`, `line`, `column`, `option`, `value`, `expected`, `remedy`) and
            their expected values. For `file`, the file's name is enough.
    """
    with pytest.raises(error) as caught:
        yield caught
    assert_fields(caught.value, **fields)


def assert_fields(problem: PisigmaError, **fields: Any) -> None:
    """Assert that the attributes of an exception equal `fields`; see `refused`."""
    for name, wanted in fields.items():
        stated = getattr(problem, name)
        if name == "file" and wanted is not None:
            is_name = os.sep not in str(wanted)
            stated, wanted = os.path.basename(stated or "") if is_name else stated, str(wanted)
        assert stated == wanted, f"{name} of '{problem}' is {stated!r}, not {wanted!r}"


def problem_of(result: Result) -> PisigmaError:
    """Return the exception that ended a command run by `CliRunner`."""
    problem: BaseException | None = result.exc_info[1] if result.exc_info else None
    while problem is not None and not isinstance(problem, PisigmaError):
        problem = problem.__context__
    assert problem is not None, f"no PisigmaError ended the command: {result.output}"
    return problem


def numbers_in(text: str) -> list[float]:
    """The numbers that a sentence states, in their order; digits within names do not count."""
    return [float(number) for number in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w])", text)]
