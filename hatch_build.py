"""The README as a package index shows it: without pictures and without links into the repository, which break there."""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

PICTURE = re.compile(r"^!\[[^\]]*\]\([^)]*\)\n\n(?:\*[^*]+\*\n\n)?", re.MULTILINE)
"""A picture on a line of its own, with the caption below it."""

LINK = re.compile(r"\[([^\]]+)\]\((?!https?://|#)[^)]+\)")
"""A link to a file in the folder of the README."""

MARK = re.compile(r"<!--.*?-->\n", re.DOTALL)


def readme_for_index(text: str) -> str:
    """Leave pictures and comments out, and only the words of links to files."""
    return LINK.sub(r"\1", MARK.sub("", PICTURE.sub("", text)))


class ReadmeHook(MetadataHookInterface):
    """Gives the build the README's text; called by hatchling."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the field `readme`, which pyproject.toml declares as dynamic."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": readme_for_index(text)}
