"""The models that a server answers for; they are loaded again without a call being dropped."""

import math
import struct
import sys
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pisigma.files.errors import ModelError, PisigmaError, RequestError, nearest_choice
from pisigma.files.model_files import is_model, model_hash
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.model.inverse.corrected_ik import CorrectedIK, load
from pisigma.model.inverse.solution import Solution


@dataclass(frozen=True, eq=False)
class ServedModel:
    """One model.

    Attributes:
        folder: that it was read from.
        ik: its corrected inverse kinematics.
        sha256: of its `model.yaml`.
    """

    folder: Path
    ik: CorrectedIK
    sha256: str

    @staticmethod
    def read(folder: Path) -> "ServedModel":
        """Load a model folder, and solve one pose so that the first request does not wait for the kernels.

        Raises:
            ModelError: the folder is no whole model.
        """
        sha256 = (
            model_hash(folder) if is_model(folder) else ""
        )  # before it is loaded: it may be written anew meanwhile
        ik = load(folder)
        ik(np.eye(4), near=np.zeros(len(ik.joints)), throw=False)
        return ServedModel(folder, ik, sha256)

    @property
    def name(self) -> str:
        """What requests call it: the name of its folder."""
        return self.folder.name

    @cached_property
    def per_file_unit(self) -> list[float]:
        """For every joint, degrees in a radian or millimetres in a metre."""
        return [180 / math.pi if turns else 1e3 for turns in self.ik.revolute]

    @cached_property
    def joints_key(self) -> str:
        """What messages call its joint values: `q_deg` where all joints turn, else `q` [deg or mm]."""
        return "q_deg" if self.ik.revolute.all() else "q"

    @cached_property
    def quick(self) -> bool:
        """Whether the compiled kernels solve its poses, in microseconds; coupled joints are solved around them."""
        controller = self.ik.controller
        if controller is None:
            return self.ik.compiled is not None
        return controller.ik.compiled is not None and not controller.coupling.passive

    @cached_property
    def _near(self) -> struct.Struct:
        """How joint values stand in bytes."""
        return struct.Struct(f"<{len(self.ik.joints)}d")

    @cached_property
    def direct(self) -> CompiledIK | None:
        """The kernels, where they solve its poses from numbers as they stand in a message."""
        return self.ik.compiled if self.ik.controller is None and sys.byteorder == "little" else None

    def solve(self, T_base_tool: bytes, near: bytes) -> list[float]:
        """Solve a pose whose numbers stand in bytes, little-endian; what is no pose gets INVALID_POSE.

        Args:
            T_base_tool: 16 doubles, row by row [m].
            near: a double for every joint [rad or m]; all NaN for none.

        Returns:
            What `CompiledIK.solve_packed` gives.
        """
        values, kernels = self._near.unpack(near), self.direct
        if kernels is not None and self.ik.postures.contains(values):
            return kernels.solve_packed(T_base_tool, near)
        none = all(map(math.isnan, values))
        if kernels is not None:
            return kernels.solve_packed(
                T_base_tool, b"" if none else self._near.pack(*[math.nan] * len(values))
            )
        T = np.frombuffer(T_base_tool, "<f8").reshape(4, 4)
        return solution_row(self.ik(T, near=None if none else np.array(values), throw=False))


def solution_row(solution: Solution) -> list[float]:
    """The solution of one pose as `CompiledIK.solve_packed` gives it."""
    residuals = float(solution.position_residual), float(solution.rotation_residual)
    numbers = *residuals, float(solution.domain_measure), float(solution.status), float(solution.branch)
    return [*solution.q.tolist(), *solution.q_nominal.tolist(), *numbers]


def model_folders(folder: Path) -> list[Path]:
    """Give the model folders in a folder, by name; damaged ones, too, so that loading them names the damage.

    Raises:
        ModelError: there are none.
    """
    inside = sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    folders = [path for path in inside if is_model(path) or any(path.glob("*.safetensors"))]
    if not folders:
        raise ModelError(f"{folder}: holds no model folders; give the folder that your model folders lie in.")
    return folders


def _sound(folders: Iterable[Path], problems: list[str]) -> list[ServedModel]:
    """Load the models that can be loaded; `problems` gets a sentence for every other one."""
    models = []
    for folder in folders:
        try:
            models.append(ServedModel.read(folder))
        except (PisigmaError, OSError) as problem:
            problems.append(f"{folder} is not served: {problem}")
    return models


class ServedModels:
    """Models by index and by name; an index stays that of its model for as long as the server runs.

    Attributes:
        problems: with `within`, sentences on the folders that could not be loaded and are not served.
    """

    def __init__(self, folders: Iterable[Path], within: Path | None = None) -> None:
        """Load model folders.

        Args:
            folders: of the models.
            within: folder that is searched for further models when they are loaded again; of the models in it, damaged
                ones are left out.

        Raises:
            ModelError: a folder is no whole model; with `within`, none is.
        """
        self._within, self._lock = within, threading.Lock()
        self.problems: list[str] = []
        if within is None:
            self._models: Sequence[ServedModel] = [ServedModel.read(folder) for folder in folders]
            return
        self._models = _sound(folders, self.problems)
        if not self._models:
            raise ModelError(f"{within}: none of its model folders can be served: {' '.join(self.problems)}")

    def __len__(self) -> int:
        return len(self._models)

    def __getitem__(self, index: int) -> ServedModel:
        return self._models[index]

    def find(self, name: object) -> ServedModel:
        """Give the model of a name or an index; without one the only model.

        Raises:
            RequestError: there is none, or there are several and None is given.
        """
        models = self._models
        if name is None and len(models) == 1:
            return models[0]
        if type(name) is int and 0 <= name < len(models):
            return models[name]
        names = [model.name for model in models]
        if isinstance(name, str) and name in names:
            return models[names.index(name)]
        raise RequestError(
            f"'model' is {name!r}; give the name or the index of a model. {nearest_choice(str(name), names)}"
        )

    def reload(self) -> list[str]:
        """Load the models whose folders have changed and, with `within`, new ones; give what went wrong.

        The others, and those that cannot be loaded, answer on as they are.
        """
        with self._lock:
            problems: list[str] = []
            models = [self._newest(model, problems) for model in self._models]
            there = {model.folder for model in models}
            try:
                new = [] if self._within is None else model_folders(self._within)
            except (PisigmaError, OSError) as problem:
                problems.append(str(problem))
                new = []
            self._models = models + _sound([folder for folder in new if folder not in there], problems)
        return problems

    @staticmethod
    def _newest(model: ServedModel, problems: list[str]) -> ServedModel:
        try:
            return model if model_hash(model.folder) == model.sha256 else ServedModel.read(model.folder)
        except (PisigmaError, OSError) as problem:
            problems.append(str(problem))
            return model
