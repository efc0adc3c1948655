"""What cards are made of: their file name and Markdown tables."""

from collections.abc import Sequence

CARD = "README.md"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def use_text(name: str) -> str:
    """How a model is used, as a piece of Python."""
    return (
        f'```python\nimport pisigma\n\nik = pisigma.load("models/{name}")\n'
        "solution = ik(T_base_tool)  # (*batch, 4, 4) [m]\n"
        "solution.q, solution.status  # joint values to command [rad or m], and whether to trust them\n```"
    )
