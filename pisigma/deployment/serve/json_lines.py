"""Requests and answers as JSON objects, one a line."""

import json
import math
import struct
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
from pydantic_core import from_json

from pisigma.deployment.serve.metrics import Metrics
from pisigma.deployment.serve.models import ServedModel, ServedModels, solution_row
from pisigma.deployment.serve.protocol import STATUS_NAMES, AbstractProtocol, BrokenStreamError, Reply
from pisigma.files.errors import PisigmaError, RequestError, nearest_choice, printable
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot.kernels.array_kinematics import transform_entries, xyzrpy_of
from pisigma.robot.kinematics.status import Status

LONGEST_LINE = 2**20
"""[bytes] A path of some 8,000 poses."""
LARGEST = 1e9
"""[mm or deg] No pose or joint has a larger value."""
LONGEST_ID = 200
"""Letters of an id that is a text."""

_TASKS = ("pose", "path", "q_deg", "q", "ask")
"""Keys of which a request has exactly one; it says what is wanted."""
_NEAR = ("near_deg", "near")
_AXES = ("ignore_axes", "tolerance_mm", "tolerance_deg", "elbow_deg")
_KEYS = {
    "pose": {"id", "model", *_NEAR, *_AXES, "branch", "approach", "accuracy", "brief"},
    "path": {"id", "model", *_NEAR, *_AXES, "branch"},
    "q_deg": {"id", "model", "approach", "accuracy"},
    "q": {"id", "model", "approach", "accuracy"},
    "ask": {"id", "model"},
}
"""Of every task the keys that a request may hold besides."""
_QUESTIONS = ("health", "models", "reload")

_PLAIN = {"id", "model", "pose", *_NEAR, "brief"}
"""Keys of requests for poses that state no task of their own."""
_POSE = struct.Struct("<16d")

_REACHING = frozenset(float(status) for status in Status if status.reaches)
_encode = json.JSONEncoder(allow_nan=False, separators=(", ", ": ")).encode


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no number of JSON")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        raise ValueError("a key stands there twice")
    return values


_decode_strictly = json.JSONDecoder(object_pairs_hook=_object, parse_constant=_refuse_constant).decode


def _decode(message: bytes) -> Any:
    """Read JSON in which no key stands twice: every key takes a colon, so where there are no more of them, none does.

    Raises:
        ValueError: it is no such JSON.
        RecursionError: it is nested too deeply.
    """
    try:
        values = from_json(message, allow_inf_nan=False, cache_strings="keys")
        if isinstance(values, dict) and message.count(b":") == len(values):
            return values
    except ValueError:
        pass  # what is wrong is said below
    return _decode_strictly(message.decode())


class JsonLines(AbstractProtocol):
    """A line of JSON in, a line of JSON out; see docs/reference/serve-protocol.md."""

    def __init__(self, models: ServedModels, metrics: Metrics) -> None:
        self._models, self._metrics = models, metrics

    def cut(self, received: bytearray) -> int:
        """Give the length of the first line with its end; see `AbstractProtocol`.

        Raises:
            BrokenStreamError: the line is longer than `LONGEST_LINE`.
        """
        length = received.find(b"\n") + 1
        if length > LONGEST_LINE or (not length and len(received) > LONGEST_LINE):
            raise BrokenStreamError(self.broken())
        return length

    def answer(self, message: bytes) -> Reply:
        """Answer a line."""
        begun = time.perf_counter_ns()
        request: dict[str, Any] = {}
        try:
            request = _read(message)
            job, slow = self._job(request)
        except (PisigmaError, ValueError, RecursionError) as problem:
            return self._refuse(request, problem, begun)
        if slow:
            return lambda: self._carry_out(request, job, begun)
        return self._carry_out(request, job, begun)

    def broken(self) -> bytes:
        """Say that what came is no line."""
        words = f"this is no line, or one that is longer than {LONGEST_LINE} bytes; send a path in pieces."
        return _line({"id": None, "error": words})

    def token_of(self, message: bytes) -> bytes | None:
        """The token of `{"token": "..."}`."""
        try:
            request = _decode(message)
        except (ValueError, RecursionError):
            return None
        token = request.get("token") if isinstance(request, dict) else None
        return token.encode() if isinstance(token, str) else None

    def admission(self, admitted: bool) -> bytes:
        """Say whether the token was the right one."""
        if admitted:
            return _line({"status": "admitted"})
        words = 'the token is missing or wrong; send {"token": "..."} as the first line, by ZeroMQ in every message.'
        return _line({"id": None, "error": words})

    def _job(self, request: dict[str, Any]) -> tuple[Callable[[], tuple[str, dict[str, Any]]], bool]:
        """What gives the status and the values of an answer, and whether that takes its time.

        Raises:
            RequestError: the request cannot be understood.
        """
        tasks = [key for key in _TASKS if key in request]
        if len(tasks) != 1:
            raise RequestError(
                f"a request has exactly one of the keys {', '.join(_TASKS)}; this one has {len(tasks)} of them."
            )
        task = tasks[0]
        for key in request.keys() - _KEYS[task] - {task}:
            raise RequestError(f"'{key}' does not go with '{task}'; {nearest_choice(key, _KEYS[task])}")
        if task == "ask":
            return self._question(request)
        model = self._models.find(request.get("model"))
        slow = not model.quick or task == "path" or _flag(request, "accuracy")
        solve = {"pose": _solve, "path": _follow}.get(task, _forward)
        return (lambda: solve(model, request)), slow

    def _question(self, request: dict[str, Any]) -> tuple[Callable[[], tuple[str, dict[str, Any]]], bool]:
        """Answer on the server itself.

        Raises:
            RequestError: there is no such question.
        """
        asked = request["ask"]
        if asked not in _QUESTIONS:
            raise RequestError(f"'ask' is {asked!r}; {nearest_choice(str(asked), _QUESTIONS)}")
        if asked == "health":
            return (lambda: ("health", asdict(self._metrics.summary()))), False
        if asked == "models":
            records = [_model_record(self._models[index]) for index in range(len(self._models))]
            return (lambda: ("models", {"models": records})), False
        return (lambda: ("reload", {"problems": self._models.reload(), "models": len(self._models)})), True

    def _carry_out(
        self, request: dict[str, Any], job: Callable[[], tuple[str, dict[str, Any]]], begun: int
    ) -> bytes:
        try:
            status, values = job()
            reply = _line({"id": request.get("id"), **values})
        except Exception as problem:
            return self._refuse(request, problem, begun)
        self._metrics.count(status, begun)
        return reply

    def _refuse(self, request: dict[str, Any], problem: Exception, begun: int) -> bytes:
        """Say what is wrong with a request; its id is given back where that could be read."""
        if isinstance(problem, PisigmaError | ValueError):
            sentence = printable(str(problem))
        elif isinstance(problem, RecursionError):
            sentence = "the line is no request: it is nested too deeply."
        else:
            sentence = printable(
                f"a defect of pisigma ({type(problem).__name__}: {problem}); please report it."
            )
        reply = _line({"id": request.get("id"), "error": sentence})
        self._metrics.count("refused", begun)
        return reply


def _line(values: dict[str, Any]) -> bytes:
    return _encode(values).encode() + b"\n"


def _read(message: bytes) -> dict[str, Any]:
    """Read a request, of which only the id is checked.

    Raises:
        RequestError: it is no JSON object, or its id is neither a whole number nor a short text.
    """
    try:
        request = _decode(message)
    except ValueError as problem:
        raise RequestError(f"the line is no JSON object ({problem}).") from None
    if not isinstance(request, dict):
        raise RequestError(f"the line holds a JSON {type(request).__name__}; send an object.")
    name = request.get("id")
    if name is not None and type(name) is not int and not (isinstance(name, str) and len(name) <= LONGEST_ID):
        raise RequestError(f"'id' has to be a whole number or a text of at most {LONGEST_ID} letters.")
    return request


def _solve(model: ServedModel, request: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Solve one pose."""
    entries, near = _entries(request["pose"], "pose"), _near(model, request)
    if model.direct is not None and request.keys() <= _PLAIN:
        beside = b"" if near is None else struct.pack(f"<{len(near)}d", *near)
        row = model.direct.solve_packed(_POSE.pack(*entries), beside)
        values = _record(model, row, model.ik.axes.ignored)
    else:
        approach = _numbers(request, "approach", len(model.ik.joints)) if "approach" in request else None
        ik, T = _for_task(model, request), np.reshape(entries, (4, 4))
        solution = ik(T, near=near, branch=_branch(request), approach=approach)
        values = _record(model, solution_row(solution), solution.ignored_axes)
        if _flag(request, "accuracy"):
            values["accuracy_mm"] = _millimetres(solution.accuracy)
    return values["status"], _brief(model, values) if _flag(request, "brief") else values


def _record(model: ServedModel, row: list[float], ignored_axes: tuple[str, ...]) -> dict[str, Any]:
    """The values of an answer to one pose, from what `CompiledIK.solve_packed` gives."""
    units = model.per_file_unit
    position, rotation, measure, status, branch = row[2 * len(units) :]
    values: dict[str, Any] = {model.joints_key: None, "status": STATUS_NAMES[status]}
    if status in _REACHING:
        values[model.joints_key] = [q * unit for q, unit in zip(row, units, strict=False)]
        values["branch"] = model.ik.branches[int(branch)]
        values["position_residual_mm"] = _millimetres(position)
        values["rotation_residual_deg"] = math.degrees(rotation)
        values["domain_measure"] = _or_none(measure)
    if ignored_axes:
        values["ignored_axes"] = ignored_axes
    if status != Status.REACHED:
        values["sentence"] = Status(int(status)).sentence
    return values


def _brief(model: ServedModel, values: dict[str, Any]) -> dict[str, Any]:
    """Joint values to 1e-6 deg or mm, and the status: what controllers with short strings can read."""
    q = values[model.joints_key]
    return {model.joints_key: q and [round(value, 6) for value in q], "status": values["status"]}


def _follow(model: ServedModel, request: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Solve a path."""
    poses = request["path"]
    if not isinstance(poses, list) or not poses:
        raise RequestError(
            "'path' has to be a list of poses [x_mm, y_mm, z_mm, roll_deg, pitch_deg, yaw_deg]."
        )
    T = np.reshape([_entries(pose, f"path[{row}]") for row, pose in enumerate(poses)], (-1, 4, 4))
    path = _for_task(model, request).path(T, near=_near(model, request), branch=_branch(request))
    q = (np.asarray(path.solution.q) * np.array(model.per_file_unit)).tolist()
    return "path", {
        model.joints_key: [row if math.isfinite(row[0]) else None for row in q],
        "status": [STATUS_NAMES[status] for status in path.solution.status.tolist()],
        "switches": [asdict(switch) for switch in path.switches],
    }


def _forward(model: ServedModel, request: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Where the calibrated arm goes."""
    q = _joints(model, request, "q_deg", "q")
    approach = _numbers(request, "approach", len(q)) if "approach" in request else None
    x, y, z, *angles = xyzrpy_of(model.ik.forward(q, approach=approach))
    values: dict[str, Any] = {"pose": [x * 1e3, y * 1e3, z * 1e3, *map(math.degrees, angles)]}
    if _flag(request, "accuracy"):
        values["accuracy_mm"] = _millimetres(model.ik.accuracy(q))
    return "forward", values


def _model_record(model: ServedModel) -> dict[str, Any]:
    per_unit = np.array(model.per_file_unit)[:, None] * model.ik.limits
    return {
        "name": model.name,
        "sha256": model.sha256,
        "joints": model.ik.joints,
        "units": ["deg" if turns else "mm" for turns in model.ik.revolute],
        "limits": per_unit.round(9).tolist(),
        "branches": model.ik.branches,
    }


def _entries(pose: Any, name: str) -> tuple[float, ...]:
    """The 16 entries of the wanted pose T_base_tool [m], row by row, of x, y, z [mm], roll, pitch, yaw [deg]."""
    x, y, z, *angles = _numbers({name: pose}, name, 6)
    return transform_entries(x / 1e3, y / 1e3, z / 1e3, *map(math.radians, angles))


def _near(model: ServedModel, request: dict[str, Any]) -> list[float] | None:
    near = _joints(model, request, *_NEAR) if request.keys() & _NEAR else None
    if near is not None and not model.ik.postures.contains(near):
        raise RequestError(
            f"'{_NEAR[model.joints_key != 'q_deg']}' lies more than a full turn (or 1 m) beyond the joint limits of "
            f"model '{model.name}'; give the joint values where the robot stands, in {_units(model)}."
        )
    return near


def _joints(model: ServedModel, request: dict[str, Any], in_degrees: str, mixed: str) -> list[float]:
    """Joint values [rad or m]; the key says whether all joints have to turn.

    Raises:
        RequestError: another key is wanted, or the values do not fit.
    """
    wanted, other = (in_degrees, mixed) if model.joints_key == "q_deg" else (mixed, in_degrees)
    if other in request:
        raise RequestError(f"'{other}' is not for model '{model.name}'; give '{wanted}', in {_units(model)}.")
    values, units = _numbers(request, wanted, len(model.ik.joints)), model.per_file_unit
    return [value / unit for value, unit in zip(values, units, strict=True)]


def _units(model: ServedModel) -> str:
    return "deg" if model.joints_key == "q_deg" else "deg and mm"


def _numbers(request: dict[str, Any], key: str, count: int) -> list[float]:
    """A list of finite numbers.

    Raises:
        RequestError: it is anything else.
    """
    values = request[key]
    if not isinstance(values, list) or len(values) != count:
        length = len(values) if isinstance(values, list) else "no list"
        raise RequestError(f"'{key}' has to be a list of {count} numbers; {length} came.")
    for value in values:
        if type(value) not in (float, int) or not -LARGEST <= value <= LARGEST:
            raise RequestError(
                f"'{key}' holds {str(value)[:40]!r}; give {count} numbers [mm or deg] below {LARGEST:g}."
            )
    return values


def _for_task(model: ServedModel, request: dict[str, Any]) -> CorrectedIK:
    """The inverse kinematics for the axes of the tool that count.

    Raises:
        RequestError: a value is of another kind.
        PoseError: see `CorrectedIK.for_task`.
    """
    if not request.keys() & {*_AXES}:
        return model.ik
    names = request.get("ignore_axes")
    if names is not None and not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
        raise RequestError(f"'ignore_axes' is {names!r}; give a list of names of axes.")
    elbow = None
    if "elbow_deg" in request:
        elbow = math.radians(_numbers({"elbow_deg": [request["elbow_deg"]]}, "elbow_deg", 1)[0])
    return model.ik.for_task(
        names, _tolerance(request, "tolerance_mm"), _tolerance(request, "tolerance_deg"), elbow
    )


def _tolerance(request: dict[str, Any], key: str) -> list[float] | None:
    """Tolerances of three axes, of which one number says all; None where none is stated."""
    if key not in request:
        return None
    stated = request[key]
    return _numbers(request if isinstance(stated, list) else {key: [stated] * 3}, key, 3)


def _branch(request: dict[str, Any]) -> str | None:
    branch = request.get("branch")
    if branch is None or isinstance(branch, str):
        return branch
    raise RequestError(f"'branch' is {branch!r}; give the name of a branch.")


def _flag(request: dict[str, Any], key: str) -> bool:
    value = request.get(key, False)
    if isinstance(value, bool):
        return value
    raise RequestError(f"'{key}' is {value!r}; give true or false.")


def _millimetres(length: Any) -> float | None:
    return _or_none(float(length) * 1e3)


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
