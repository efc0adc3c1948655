"""Frames and tools that are active at a statement of a program, as far as control flow determines them."""

from collections import Counter
from collections.abc import Sequence
from itertools import takewhile
from typing import Literal, NamedTuple

from pisigma.deployment.export.rewriting.scan import Frame

DEPENDS_ON_PATH = "depends on the path through the program"
DEPENDS_ON_CALLER = "depends on the caller of the routine"


class Step(NamedTuple):
    """One statement that affects control flow, frames or tools.

    Attributes:
        kind: "routine", "loop" and "branch" start a block, and "end" ends the innermost one; "else" starts another
            alternative of a branch; "jump" is a label or a jump; "set" sets a frame or a tool; "call" calls a routine;
            "other" is anything else.
        name: name of the routine that starts or is called, or of the frame or tool that is set.
    """

    kind: Literal["routine", "loop", "branch", "else", "end", "jump", "set", "call", "other"]
    name: str = ""


class ActiveFrames:
    """Frame or tool of every name, or the reason why it is uncertain, while a reader advances through the steps.

    A value is certain if all paths through the program lead to it. A value that is set in a loop or a branch is certain
    after its statement in that block, but neither after the block nor earlier in the same loop. Values that a called
    routine sets are uncertain, as are values at the start of a routine if the program sets them in several places. A
    routine in another file may set all values.
    """

    def __init__(self, steps: Sequence[Step], before: dict[str, Frame | str]) -> None:
        """Analyse all statements.

        Args:
            steps: steps of the whole program, in the order of the text.
            before: values before the first step.
        """
        self._steps, self._values = steps, dict(before)
        self._saved: list[dict[str, Frame | str]] = []
        self._places = Counter(step.name for step in steps if step.kind == "set")
        self._open: list[tuple[int, ...]] = []
        """For every step, the steps that started the enclosing blocks."""
        self._ends: dict[int, int] = {}
        """For steps that end a block, the step that started it."""
        blocks: list[int] = []
        for number, step in enumerate(steps):
            if step.kind == "end" and blocks:
                self._ends[number] = blocks.pop()
            self._open.append(tuple(blocks))
            if step.kind in ("routine", "loop", "branch"):
                blocks.append(number)
        self._of_routine: dict[int, list[int]] = {-1: []}
        """For every step, the step that started its routine; -1 outside all routines."""
        for number in range(len(steps)):
            self._of_routine.setdefault(self._routine(number), []).append(number)
        self._set_by: dict[str, set[str]] = {step.name: set() for step in steps if step.kind == "routine"}
        """Names that every routine sets, directly or through routines that it calls."""
        acting = {
            first: [number for number in inside if steps[number].kind in ("set", "call")]
            for first, inside in self._of_routine.items()
            if first >= 0
        }
        self._called = {step.name for step in steps if step.kind == "call"}
        self._certain_before = {name for name, value in before.items() if not isinstance(value, str)}
        for _ in acting:  # the longest path of a name passes through every routine once
            for first, inside in acting.items():
                self._set_by[steps[first].name].update(*map(self._set_at, inside))

    def __getitem__(self, name: str) -> Frame | str:
        """Return the value of a name, or the reason why it is uncertain."""
        return self._values[name]

    def advance_past(self, step_index: int, value: Frame | str = "") -> None:
        """Advance past a statement.

        Args:
            step_index: index of the step.
            value: value of a "set", or the reason why it is unknown.
        """
        step = self._steps[step_index]
        if step.kind == "set":
            self._values[step.name] = (
                f"{step.name} {DEPENDS_ON_PATH}" if self._is_reached_twice(step_index) else value
            )
        elif step.kind == "call":
            where = "is" if step.name in self._set_by else "may be"
            whose = "" if step.name in self._set_by else " in another file"
            for name in self._set_at(step_index):
                self._values[name] = f"{name} {where} set by the routine {step.name}{whose}"
        elif step.kind == "else" and self._saved:
            self._values = dict(self._saved[-1])
            # calls in a condition also affect the following parts
            begin = self._open[step_index][-1] if self._open[step_index] else step_index
            self._doubt(self._set_in(begin, ("call",)), DEPENDS_ON_PATH)
        elif step.kind == "end":
            self._end(step_index)
        elif step.kind in ("routine", "loop", "branch"):
            self._saved.append(dict(self._values))
            if step.kind == "loop":
                self._doubt(self._set_in(step_index), DEPENDS_ON_PATH)
            elif step.kind == "routine":
                self._doubt(self._set_elsewhere(step.name), DEPENDS_ON_CALLER)

    def _end(self, number: int) -> None:
        """Leave a block."""
        if number not in self._ends:
            return
        begin, saved = self._ends[number], self._saved.pop()
        if self._steps[begin].kind != "routine":
            self._doubt(self._set_in(begin), DEPENDS_ON_PATH)
            return
        nested = bool(self._open[number])
        kept = {name for name, places in self._places.items() if places == 1 and not nested}
        self._values = {name: self._values[name] if name in kept else saved[name] for name in saved}

    def _set_elsewhere(self, routine: str) -> set[str]:
        """Return the names whose values in a routine depend on its caller."""
        several = {name for name, places in self._places.items() if places > 1}
        if routine not in self._called:
            return several
        foreign = any(step.kind == "call" and step.name not in self._set_by for step in self._steps)
        return several | {name for name in self._certain_before if foreign or self._places[name]}

    def _set_in(self, begin: int, kinds: Sequence[str] = ("set", "call")) -> set[str]:
        """Return the names that steps of the given kinds set in a block."""
        inside = takewhile(lambda step: begin in self._open[step], range(begin + 1, len(self._steps)))
        return {name for step in inside if self._steps[step].kind in kinds for name in self._set_at(step)}

    def _doubt(self, names: set[str], why: str) -> None:
        for name in names:
            if not isinstance(self._values[name], str):
                self._values[name] = f"{name} {why}"

    def _routine(self, number: int) -> int:
        """Return the step that started the routine around a step; -1 outside all routines."""
        return next((k for k in reversed(self._open[number]) if self._steps[k].kind == "routine"), -1)

    def _is_reached_twice(self, number: int) -> bool:
        """Return whether jumps may skip a statement that sets a value that another statement has already set."""
        inside = self._of_routine[self._routine(number)]
        jumps = any(self._steps[other].kind == "jump" for other in inside)
        return jumps and sum(self._steps[number].name in self._set_at(other) for other in inside) > 1

    def _set_at(self, number: int) -> set[str]:
        """Return the names that a step sets, directly or by a call; a routine in another file may set all names."""
        step = self._steps[number]
        if step.kind == "set":
            return {step.name}
        return self._set_by.get(step.name, set(self._values)) if step.kind == "call" else set()
