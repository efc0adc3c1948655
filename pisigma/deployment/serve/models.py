"""Models of a server, which can be reloaded without dropping a request."""

import contextlib
import datetime
import math
import struct
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.registry import export_format
from pisigma.files.errors import ModelError, PisigmaError, Place, RequestError, choice_remedy
from pisigma.files.model_files import is_model, model_hash
from pisigma.lifetime.cell.layout import is_cell
from pisigma.lifetime.cell.model_in_use import ModelInUse
from pisigma.lifetime.cell.status import status_of
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.loading import load
from pisigma.model.inverse.solution import Solution


@dataclass(frozen=True, eq=False)
class ServedModel:
    """A model of a server.

    Attributes:
        folder: folder from which the model was read.
        ik: corrected inverse kinematics of the model.
        sha256: SHA-256 of its `model.yaml`.
    """

    folder: Path
    ik: CorrectedIK
    sha256: str

    @staticmethod
    def read(folder: Path) -> "ServedModel":
        """Load a model folder, and solve one pose so that the first request does not wait for the kernels.

        Raises:
            ModelError: the folder is not a complete model.
        """
        # read before loading, because the folder may be rewritten in the meantime
        sha256 = model_hash(folder) if is_model(folder) else ""
        ik = load(folder)
        ik(np.eye(4), near=np.zeros(len(ik.joints)), throw=False)
        return ServedModel(folder, ik, sha256)

    @property
    def name(self) -> str:
        """Name of the model in requests, which is the name of its folder."""
        return self.folder.name

    @cached_property
    def short_hash(self) -> bytes:
        """The first eight bytes of `sha256`, which identify the model in binary frames."""
        return bytes.fromhex(self.sha256)[:8]

    @cached_property
    def answer_name(self) -> dict[str, str]:
        """Name of the model in answers."""
        return {"model": self.name}

    @cached_property
    def brief_answer_name(self) -> dict[str, str]:
        """Name of the model in brief answers: hexadecimal digits, which a simple parser cannot mistake for a status."""
        return {"sha256": self.short_hash.hex()}

    @cached_property
    def file_units_per_si(self) -> list[float]:
        """Degrees per radian, or millimetres per metre, for every joint."""
        return [180 / math.pi if is_revolute else 1e3 for is_revolute in self.ik.revolute]

    @cached_property
    def joints_key(self) -> str:
        """Return the key of joint values in messages: `q_deg` if all joints are revolute, otherwise `q` [deg or mm]."""
        return "q_deg" if self.ik.revolute.all() else "q"

    @cached_property
    def has_compiled_solver(self) -> bool:
        """Whether compiled kernels solve poses in microseconds; for coupled joints, they do so in DH values."""
        controller = self.ik.controller_solver
        if controller is None:
            return self.ik.compiled is not None
        return controller.ik.compiled is not None and not controller.coupling.has_passive_joints

    @cached_property
    def urdf(self) -> str:
        """URDF of the calibrated robot, as `pisigma export --format urdf` writes it.

        Raises:
            PisigmaError: a URDF cannot describe the model.
        """
        if model_hash(self.folder) != self.sha256:
            raise ModelError(
                "the folder was changed since it was loaded", at=Place(self.folder), remedy="reload it"
            )
        request = ExportRequest(self.folder, self.folder / f"{self.name}.urdf")
        return str(export_format("urdf").write(request).content)

    @cached_property
    def _near(self) -> struct.Struct:
        """Byte layout of joint values."""
        return struct.Struct(f"<{len(self.ik.joints)}d")

    @cached_property
    def byte_solver(self) -> CompiledIK | None:
        """Return the kernels if they can solve poses directly from the bytes of a message, otherwise None."""
        return self.ik.compiled if self.ik.controller_solver is None and sys.byteorder == "little" else None

    def solve(self, T_base_tool: bytes, near: bytes) -> list[float]:
        """Solve a pose that is given as little-endian bytes; the status of an invalid pose is INVALID_POSE.

        Args:
            T_base_tool: 16 doubles, row by row [m].
            near: one double for every joint [rad or m]; all NaN if no joint values are preferred.

        Returns:
            The row of `CompiledIK.solve_packed`.
        """
        values, kernels = self._near.unpack(near), self.byte_solver
        if kernels is not None and self.ik.plausible_joints.contains(values):
            return kernels.solve_packed(T_base_tool, near)
        none = all(map(math.isnan, values))
        if kernels is not None:
            return kernels.solve_packed(
                T_base_tool, b"" if none else self._near.pack(*[math.nan] * len(values))
            )
        T = np.frombuffer(T_base_tool, "<f8").reshape(4, 4)
        return solution_row(self.ik(T, near=None if none else np.array(values), throw=False))


@dataclass(frozen=True)
class ModelStatus:
    """State of a served model, for operators.

    Attributes:
        model: name of the model.
        sha256: SHA-256 of its `model.yaml`.
        day: day of the newest rows to which the model was fitted (ISO 8601); empty if no cell states it.
        age_days: days since this day; None if unknown.
        state: state of the cell, as printed by `pisigma status`; "not_in_cell" for a model outside of a cell,
            "not_in_use" if the cell uses another model, "unreadable" if the state cannot be determined.
        reason: sentence that states the reason for this state.
    """

    model: str
    sha256: str
    day: str = ""
    age_days: int | None = None
    state: str = "not_in_cell"
    reason: str = ""

    @staticmethod
    def of_model(model: ServedModel) -> "ModelStatus":
        """Return the status of a model today, from the history of the cell that contains it."""
        cell = model.folder.absolute().parent.parent
        named = ModelStatus(model.name, model.sha256)
        if not is_cell(cell):
            return named
        try:
            status = status_of(cell)
        except (PisigmaError, OSError) as problem:
            return replace(named, state="unreadable", reason=str(problem))
        days = [one.day for one in status.facts.models if one.name == model.name and one.day]
        if days:
            age = datetime.date.fromisoformat(status.facts.today) - datetime.date.fromisoformat(days[-1])
            named = replace(named, day=days[-1], age_days=age.days)
        in_use = status.facts.in_use
        if in_use is None or in_use.name != model.name:
            return replace(named, state="not_in_use", reason="the cell uses another model, or none")
        return replace(named, state=status.step.state, reason=status.step.reason)


def solution_row(solution: Solution) -> list[float]:
    """Convert the solution of one pose to a row as from `CompiledIK.solve_packed`."""
    residuals = float(solution.position_residual), float(solution.rotation_residual)
    numbers = *residuals, float(solution.domain_measure), float(solution.status), float(solution.branch)
    return [*solution.q.tolist(), *solution.q_nominal.tolist(), *numbers]


def model_folders(folder: Path) -> list[Path]:
    """Return the model folders in a folder by name, including damaged folders, so that loading reports the damage.

    Raises:
        ModelError: the folder contains no model folder.
    """
    inside = sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    folders = [path for path in inside if is_model(path) or any(path.glob("*.safetensors"))]
    if not folders:
        raise ModelError(
            "the folder contains no model folders",
            at=Place(folder),
            remedy="give the folder that contains your models",
        )
    return folders


def _loadable(folders: Iterable[Path], problems: list[str]) -> list[ServedModel]:
    """Load the models that can be loaded, and append a sentence to `problems` for every other model."""
    models = []
    for folder in folders:
        try:
            models.append(ServedModel.read(folder))
        except (PisigmaError, OSError) as problem:
            problems.append(f"{folder} is not served: {problem}")
    return models


class ServedModels:
    """Models by index and by name; the index of a model does not change while the server runs.

    Attributes:
        problems: with `within`, sentences on folders that could not be loaded and are not served; for a cell, warnings.
    """

    def __init__(
        self, folders: Iterable[Path] = (), within: Path | None = None, cell: Path | None = None
    ) -> None:
        """Load model folders.

        Args:
            folders: model folders.
            within: folder that is searched for other models on reload; damaged models in it are left out.
            cell: cell whose model in use is served instead, also after it changes; see `follow_changes`.

        Raises:
            ModelError: a folder is not a complete model; with `within`, no folder is a complete model.
        """
        self._within, self._lock = within, threading.Lock()
        self.problems: list[str] = []
        self._models: Sequence[ServedModel] = ()
        self._in_use = None if cell is None else ModelInUse(cell, "serve", self._replace)
        if self._in_use is not None:
            self.problems.extend(self._in_use.warnings)
            return
        if within is None:
            self._models = [ServedModel.read(folder) for folder in folders]
            return
        self._models = _loadable(folders, self.problems)
        if not self._models:
            raise ModelError(
                f"none of the model folders can be served: {' '.join(self.problems).rstrip('.')}",
                at=Place(within),
            )

    def __len__(self) -> int:
        return len(self._models)

    def __getitem__(self, index: int) -> ServedModel:
        return self._models[index]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the models, such as about torques that are modelled, with the names of the models."""
        return tuple(f"{model.name}: {one}" for model in self._models for one in model.ik.warnings)

    @property
    def is_use_forbidden(self) -> bool:
        """Whether exports that are active on the controller of the cell forbid the use of any model."""
        return self._in_use is not None and bool(self._in_use.findings.refusal)

    def find_model(self, name: object) -> ServedModel:
        """Return the model with a given name or index; None stands for the only model.

        Raises:
            RequestError: there is no such model, None is given and there are several, or the model must not be used
                with the export that is active on the controller.
        """
        if self.is_use_forbidden and self._in_use is not None:
            raise RequestError(self._in_use.findings.refusal)
        models = self._models
        if name is None and len(models) == 1:
            return models[0]
        if type(name) is int and 0 <= name < len(models):
            return models[name]
        names = [model.name for model in models]
        if isinstance(name, str) and name in names:
            return models[names.index(name)]
        raise RequestError(
            expected="the name or the index of a model",
            value=repr(name)[:40],
            option="model",
            remedy=choice_remedy(str(name), names),
        )

    def reload(self) -> list[str]:
        """Reload the models whose folders have changed and, with `within`, load new models; return the problems.

        A model that cannot be reloaded continues to answer as before.
        """
        if self._in_use is not None:
            self._in_use.load_if_changed(retry_failed=True)
            return list(self._in_use.warnings)
        with self._lock:
            problems: list[str] = []
            models = [self._newest(model, problems) for model in self._models]
            there = {model.folder for model in models}
            try:
                new = [] if self._within is None else model_folders(self._within)
            except (PisigmaError, OSError) as problem:
                problems.append(str(problem))
                new = []
            self._models = models + _loadable([folder for folder in new if folder not in there], problems)
        return problems

    @contextlib.contextmanager
    def follow_changes(self, report: Callable[[str], None]) -> Iterator[None]:
        """Load every new model in use of a cell, between requests, until the block ends.

        Args:
            report: function that is called with warnings, and with a sentence for every model that could not be loaded.
        """
        if self._in_use is not None:
            self._in_use.follow(report)
        yield
        if self._in_use is not None:
            self._in_use.stop()

    def _replace(self, folder: Path) -> None:
        """Answer all later requests with the model in a folder, if it is a new model."""
        if not (
            self._models and (folder, model_hash(folder)) == (self._models[0].folder, self._models[0].sha256)
        ):
            self._models = [ServedModel.read(folder)]

    @staticmethod
    def _newest(model: ServedModel, problems: list[str]) -> ServedModel:
        try:
            return model if model_hash(model.folder) == model.sha256 else ServedModel.read(model.folder)
        except (PisigmaError, OSError) as problem:
            problems.append(str(problem))
            return model
