"""Convert formulas to MathML when the pages are built, so that reading them needs neither network nor scripts."""

import html
import re
from typing import Any

from latex2mathml.converter import convert

_FORMULA = re.compile(r'<(span|div) class="arithmatex">(?:\\\((.+?)\\\)|\\\[(.+?)\\\])</\1>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """Replace every formula by MathML; mkdocs calls this for every page."""
    return _FORMULA.sub(_mathml, content)


def _mathml(match: re.Match[str]) -> str:
    inline, block = match[2], match[3]
    latex = html.unescape(inline or block).strip()
    formula = convert(latex, display="inline" if inline else "block")
    return formula if inline else f'<div class="formula">{formula}</div>'
