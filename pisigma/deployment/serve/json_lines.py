"""Requests and answers as JSON objects, one per line."""

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
from pisigma.deployment.serve.models import ModelStatus, ServedModel, ServedModels, solution_row
from pisigma.deployment.serve.protocol import (
    STATUS_NAMES,
    AbstractProtocol,
    BrokenStreamError,
    Reply,
    pose_entries,
    read_branch,
    read_flag,
    read_numbers,
    read_tolerance,
)
from pisigma.files.errors import (
    PisigmaError,
    RequestError,
    check_choice,
    choice_remedy,
    make_printable,
    missing_extra,
)
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot.kernels.array_kinematics import xyz_zyx_of
from pisigma.robot.kinematics.status import Status

MAX_LINE_BYTES = 2**20
"""Largest length of a line [bytes], which is sufficient for a path of about 8,000 poses."""
_MAX_ID_CHARACTERS = 200

_TASKS = ("pose", "path", "q_deg", "q", "ask")
"""Keys that determine the task of a request; every request has exactly one of them."""
_NEAR = ("near_deg", "near")
_AXES = ("ignore_axes", "tolerance_mm", "tolerance_deg", "elbow_deg")
_KEYS = {
    "pose": {"id", "model", *_NEAR, *_AXES, "branch", "approach", "accuracy", "brief"},
    "path": {"id", "model", *_NEAR, *_AXES, "branch"},
    "q_deg": {"id", "model", "approach", "accuracy"},
    "q": {"id", "model", "approach", "accuracy"},
    "ask": {"id", "model"},
}
"""Other keys that a request of each task may have."""
_QUESTIONS = ("health", "models", "reload", "status", "urdf")

_PLAIN = {"id", "model", "pose", *_NEAR, "brief"}
"""Keys of requests for poses in the default axes."""
_POSE = struct.Struct("<16d")

_REACHING = frozenset(float(status) for status in Status if status.reaches)
_Job = Callable[[], tuple[str, dict[str, Any]]]
"""Function that computes status and values of an answer."""
_encode = json.JSONEncoder(allow_nan=False, separators=(", ", ": ")).encode


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a valid JSON number")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        raise ValueError("a key appears twice")
    return values


_decode_strictly = json.JSONDecoder(object_pairs_hook=_object, parse_constant=_refuse_constant).decode


def _decode(message: bytes) -> Any:
    """Read JSON in which no key appears twice.

    Every key needs a colon, so no key of an object is repeated if there are as many keys as colons.

    Raises:
        ValueError: the message is not valid JSON, or a key appears twice.
        RecursionError: the message is nested too deeply.
    """
    try:
        values = from_json(message, allow_inf_nan=False, cache_strings="keys")
        if isinstance(values, dict) and message.count(b":") == len(values):
            return values
    except ValueError:
        pass  # the strict decoder below reports the fault
    return _decode_strictly(message.decode())


class JsonLines(AbstractProtocol):
    """Protocol with one line of JSON per request and answer; see docs/reference/serve-protocol.md."""

    def __init__(self, models: ServedModels, metrics: Metrics) -> None:
        self._models, self._metrics = models, metrics

    def message_length(self, received: bytearray) -> int:
        """Return the length of the first line with its end; see `AbstractProtocol`.

        Raises:
            BrokenStreamError: the line is longer than `MAX_LINE_BYTES`.
        """
        length = received.find(b"\n") + 1
        if length > MAX_LINE_BYTES or (not length and len(received) > MAX_LINE_BYTES):
            raise BrokenStreamError(self.invalid_message_answer())
        return length

    def answer_message(self, message: bytes) -> Reply:
        """Answer a line."""
        begun = time.perf_counter_ns()
        request: dict[str, Any] = {}
        try:
            request = _read(message)
            job, slow, names = self._job(request)
        except (PisigmaError, ValueError, RecursionError) as problem:
            return self._refuse(request, problem, begun)
        if slow:
            return lambda: self._carry_out(request, job, names, begun)
        return self._carry_out(request, job, names, begun)

    def invalid_message_answer(self) -> bytes:
        """Return the answer to bytes that are not a line."""
        problem = RequestError(
            expected=f"a line of at most {MAX_LINE_BYTES} bytes", remedy="send long paths in several requests"
        )
        return _line({"id": None, "error": str(problem)})

    def token_of(self, message: bytes) -> bytes | None:
        """Return the token of `{"token": "..."}`."""
        try:
            request = _decode(message)
        except (ValueError, RecursionError):
            return None
        token = request.get("token") if isinstance(request, dict) else None
        return token.encode() if isinstance(token, str) else None

    def admission_answer(self, admitted: bool) -> bytes:
        """Return the answer to a token."""
        if admitted:
            return _line({"status": "admitted"})
        problem = RequestError(
            "the token is missing or wrong",
            option="token",
            remedy='send {"token": "..."} as the first line, or with ZeroMQ in every message',
        )
        return _line({"id": None, "error": str(problem)})

    def _job(self, request: dict[str, Any]) -> tuple[_Job, bool, dict[str, str]]:
        """Return the function that computes an answer, whether it is slow, and the name of its model in the answer.

        Raises:
            RequestError: the request is invalid.
        """
        tasks = [key for key in _TASKS if key in request]
        if len(tasks) != 1:
            raise RequestError(expected=f"exactly one of the keys {', '.join(_TASKS)}", value=len(tasks))
        task = tasks[0]
        for key in request.keys() - _KEYS[task] - {task}:
            raise RequestError(
                f"the key cannot be combined with '{task}'",
                option=key,
                remedy=choice_remedy(key, _KEYS[task]),
            )
        if task == "ask":
            return *self._question(request), {}
        model = self._models.find_model(request.get("model"))
        slow = not model.has_compiled_solver or task == "path" or read_flag(request, "accuracy")
        solve = {"pose": _solve, "path": _follow}.get(task, _forward)
        names = model.brief_answer_name if request.get("brief") else model.answer_name
        return (lambda: solve(model, request)), slow, names

    def _question(self, request: dict[str, Any]) -> tuple[_Job, bool]:
        """Return the function that answers a question about the server, and whether it is slow.

        Raises:
            RequestError: there is no such question.
        """
        asked = request["ask"]
        check_choice(RequestError, "ask", asked if isinstance(asked, str) else repr(asked), _QUESTIONS)
        if asked == "health":
            return (lambda: ("health", asdict(self._metrics.summary()))), False
        if asked == "models":
            records = [_model_record(self._models[index]) for index in range(len(self._models))]
            return (lambda: ("models", {"models": records})), False
        if asked in ("status", "urdf"):
            model = self._models.find_model(request.get("model"))
            if asked == "urdf":
                return (
                    lambda: ("urdf", {"model": model.name, "sha256": model.sha256, "urdf": model.urdf})
                ), True
            return (lambda: ("status", asdict(ModelStatus.of_model(model)))), True
        return (lambda: ("reload", {"problems": self._models.reload(), "models": len(self._models)})), True

    def _carry_out(self, request: dict[str, Any], job: _Job, names: dict[str, str], begun: int) -> bytes:
        try:
            status, values = job()
            reply = _line({"id": request.get("id"), **values, **names})
        except Exception as problem:
            return self._refuse(request, problem, begun)
        self._metrics.count(status, begun)
        return reply

    def _refuse(self, request: dict[str, Any], problem: Exception, begun: int) -> bytes:
        """Return the answer to an invalid request, with the id of the request if it could be read."""
        if isinstance(problem, ImportError):
            problem = missing_extra(problem) or problem
        if isinstance(problem, PisigmaError | ValueError):
            sentence = make_printable(str(problem))
        elif isinstance(problem, RecursionError):
            sentence = "the request is nested too deeply."
        else:
            sentence = make_printable(
                f"this is a defect in pisigma ({type(problem).__name__}: {problem}); please report it."
            )
        reply = _line({"id": request.get("id"), "error": sentence})
        self._metrics.count("refused", begun)
        return reply


def _line(values: dict[str, Any]) -> bytes:
    return _encode(values).encode() + b"\n"


def _read(message: bytes) -> dict[str, Any]:
    """Read a request, checking only its id.

    Raises:
        RequestError: the message is not a JSON object, or its id is neither an integer nor a short string.
    """
    try:
        request = _decode(message)
    except ValueError as problem:
        raise RequestError(f"expected a JSON object: {problem}", expected="a JSON object") from None
    if not isinstance(request, dict):
        raise RequestError(expected="a JSON object", value=type(request).__name__)
    name = request.get("id")
    if (
        name is not None
        and type(name) is not int
        and not (isinstance(name, str) and len(name) <= _MAX_ID_CHARACTERS)
    ):
        raise RequestError(
            f"expected an integer or a string of at most {_MAX_ID_CHARACTERS} characters", option="id"
        )
    return request


def _solve(model: ServedModel, request: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Solve one pose."""
    entries, near = pose_entries(request["pose"], "pose"), _near(model, request)
    if model.byte_solver is not None and request.keys() <= _PLAIN:
        near_bytes = b"" if near is None else struct.pack(f"<{len(near)}d", *near)
        row = model.byte_solver.solve_packed(_POSE.pack(*entries), near_bytes)
        values = _record(model, row, model.ik.task_axes.ignored)
    else:
        approach = read_numbers(request, "approach", len(model.ik.joints)) if "approach" in request else None
        ik, T = _for_task(model, request), np.reshape(entries, (4, 4))
        solution = ik(T, near=near, branch=read_branch(request), approach=approach)
        values = _record(model, solution_row(solution), solution.ignored_axes)
        if read_flag(request, "accuracy"):
            values["accuracy_mm"] = _millimetres(solution.accuracy)
    return values["status"], _brief(model, values) if read_flag(request, "brief") else values


def _record(model: ServedModel, row: list[float], ignored_axes: tuple[str, ...]) -> dict[str, Any]:
    """Return the answer to one pose from a row of `CompiledIK.solve_packed`."""
    units = model.file_units_per_si
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
    """Reduce an answer to status and joint values, rounded to 1e-6 deg or mm, for controllers with short strings."""
    q = values[model.joints_key]
    return {model.joints_key: q and [round(value, 6) for value in q], "status": values["status"]}


def _follow(model: ServedModel, request: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Solve a path."""
    poses = request["path"]
    if not isinstance(poses, list) or not poses:
        raise RequestError(
            "expected a list of poses [x_mm, y_mm, z_mm, roll_deg, pitch_deg, yaw_deg]", option="path"
        )
    T = np.reshape([pose_entries(pose, f"path[{row}]") for row, pose in enumerate(poses)], (-1, 4, 4))
    path = _for_task(model, request).path(T, near=_near(model, request), branch=read_branch(request))
    q = (np.asarray(path.solution.q) * np.array(model.file_units_per_si)).tolist()
    return "path", {
        model.joints_key: [row if math.isfinite(row[0]) else None for row in q],
        "status": [STATUS_NAMES[status] for status in path.solution.status.tolist()],
        "switches": [asdict(switch) for switch in path.switches],
    }


def _forward(model: ServedModel, request: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Compute the pose of the calibrated arm."""
    q = _joints(model, request, "q_deg", "q")
    approach = read_numbers(request, "approach", len(q)) if "approach" in request else None
    x, y, z, *angles = xyz_zyx_of(model.ik.forward(q, approach=approach))
    values: dict[str, Any] = {"pose": [x * 1e3, y * 1e3, z * 1e3, *map(math.degrees, angles)]}
    if read_flag(request, "accuracy"):
        values["accuracy_mm"] = _millimetres(model.ik.accuracy(q, approach=approach))
    return "forward", values


def _model_record(model: ServedModel) -> dict[str, Any]:
    per_unit = np.array(model.file_units_per_si)[:, None] * model.ik.limits
    return {
        "name": model.name,
        "sha256": model.sha256,
        "joints": model.ik.joints,
        "units": ["deg" if is_revolute else "mm" for is_revolute in model.ik.revolute],
        "limits": [[_or_none(bound) for bound in bounds] for bounds in per_unit.round(9).tolist()],
        "branches": model.ik.branches,
        "warnings": model.ik.warnings,
    }


def _near(model: ServedModel, request: dict[str, Any]) -> list[float] | None:
    near = _joints(model, request, *_NEAR) if request.keys() & _NEAR else None
    if near is not None and not model.ik.plausible_joints.contains(near):
        raise RequestError(
            f"a value is more than a full turn (or 1 m) outside the joint limits of model '{model.name}'",
            option=_NEAR[model.joints_key != "q_deg"],
            remedy=f"give the current joint values of the robot in {_units(model)}",
        )
    return near


def _joints(model: ServedModel, request: dict[str, Any], in_degrees: str, mixed: str) -> list[float]:
    """Return joint values [rad or m] from the key `in_degrees` if all joints are revolute, or else from `mixed`.

    Raises:
        RequestError: the request has the other key, or the values are invalid.
    """
    wanted, other = (in_degrees, mixed) if model.joints_key == "q_deg" else (mixed, in_degrees)
    if other in request:
        raise RequestError(
            f"the key does not apply to model '{model.name}'",
            option=other,
            remedy=f"give '{wanted}' in {_units(model)}",
        )
    values, units = read_numbers(request, wanted, len(model.ik.joints)), model.file_units_per_si
    return [value / unit for value, unit in zip(values, units, strict=True)]


def _units(model: ServedModel) -> str:
    return "deg" if model.joints_key == "q_deg" else "deg and mm"


def _for_task(model: ServedModel, request: dict[str, Any]) -> CorrectedIK:
    """Return the inverse kinematics for the constrained axes of the tool.

    Raises:
        RequestError: a value has the wrong type.
        PoseError: see `CorrectedIK.for_task`.
    """
    if not request.keys() & {*_AXES}:
        return model.ik
    names = request.get("ignore_axes")
    if names is not None and not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
        raise RequestError(expected="a list of names of axes", value=repr(names)[:40], option="ignore_axes")
    elbow = None
    if "elbow_deg" in request:
        elbow = math.radians(read_numbers({"elbow_deg": [request["elbow_deg"]]}, "elbow_deg", 1)[0])
    return model.ik.for_task(
        names, read_tolerance(request, "tolerance_mm"), read_tolerance(request, "tolerance_deg"), elbow
    )


def _millimetres(length: Any) -> float | None:
    return _or_none(float(length) * 1e3)


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
