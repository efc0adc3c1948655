"""Jigs: stepped blocks whose faces, at known coordinates in the jig's frame, are touched with a tip."""

import os
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float64, Int64
from pydantic import Field, model_validator
from torch import Tensor

from pisigma.files.errors import MeasurementError, choice_remedy
from pisigma.files.yaml_file import Section, parse_yaml, read_yaml

Side = Literal["-x", "+x", "-y", "+y", "-z", "+z"]
Millimetres = tuple[float, float, float]

_SKIN = 1e-7
"""Distance from a block [m] above which a point is outside the block."""


class BlockSection(Section):
    """Section of a jig file that describes a block with edges along the axes of the jig's frame.

    Attributes:
        name: name of the block, unique in the jig.
        corner_mm: corner with the smallest coordinates [mm].
        size_mm: extent along x, y and z [mm].
        faces: faces that may be touched, as outward directions.
    """

    name: str = Field(min_length=1)
    corner_mm: Millimetres
    size_mm: tuple[
        Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]
    ]
    faces: tuple[Side, ...] = ()

    @model_validator(mode="after")
    def _each_face_once(self) -> "BlockSection":
        for side in self.faces:
            if self.faces.count(side) > 1:
                raise ValueError(f"the face {side} of block '{self.name}' appears twice; remove one")
        return self


class JigDocument(Section):
    """Contents of a jig file.

    Attributes:
        name: name of the jig.
        source: source of the dimensions.
        blocks: blocks of the jig, which may touch but not overlap.
    """

    name: str = Field(min_length=1)
    source: str
    blocks: tuple[BlockSection, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _fits_together(self) -> "JigDocument":
        names = [block.name for block in self.blocks]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"the block name '{name}' appears twice; rename one")
        if not any(block.faces for block in self.blocks):
            raise ValueError("no block has a face that may be touched; name at least one in 'faces'")
        jig = self.to_jig()
        jig.check_overlaps()
        jig.check_faces()
        return self

    def to_jig(self) -> "Jig":
        """Return the jig in SI units."""
        corner = torch.tensor([block.corner_mm for block in self.blocks], dtype=torch.float64) / 1e3
        size = torch.tensor([block.size_mm for block in self.blocks], dtype=torch.float64) / 1e3
        faces = [(number, side) for number, block in enumerate(self.blocks) for side in block.faces]
        return Jig(
            name=self.name,
            source=self.source,
            block_names=tuple(block.name for block in self.blocks),
            lower=corner,
            upper=corner + size,
            block=torch.tensor([number for number, _ in faces], dtype=torch.int64),
            axis=torch.tensor(["xyz".index(side[1]) for _, side in faces], dtype=torch.int64),
            sign=torch.tensor([1.0 if side[0] == "+" else -1.0 for _, side in faces], dtype=torch.float64),
        )


@dataclass(frozen=True, eq=False)
class Jig:
    """Blocks and the faces that may be touched, in the frame of the jig [m].

    A touch on face i measures the coordinate `coordinate[i]` along axis `axis[i]`: x on y-z faces, y on x-z
    faces, z on x-y faces (Lim et al., eqs 35 to 37).

    Attributes:
        name: name of the jig.
        source: source of the dimensions.
        block_names: names of the blocks.
        lower: corner of every block with the smallest coordinates [m].
        upper: corner of every block with the largest coordinates [m].
        block: index of every face's block.
        axis: index of every face's normal axis.
        sign: outward direction of every face along its axis, +1 or -1.
    """

    name: str
    source: str
    block_names: tuple[str, ...]
    lower: Float64[Tensor, "blocks 3"]
    upper: Float64[Tensor, "blocks 3"]
    block: Int64[Tensor, " faces"]
    axis: Int64[Tensor, " faces"]
    sign: Float64[Tensor, " faces"]

    @staticmethod
    def load(jig: str | os.PathLike[str] = "stepped") -> "Jig":
        """Load a jig by its name in pisigma's catalogue, or from a YAML file.

        Raises:
            MeasurementError: `jig` is neither in the catalogue nor an existing file, or the file is not a valid jig;
                `file`, `line` and `column` state where.
        """
        name = os.fspath(jig)
        if name in catalogue():
            text = (resources.files("pisigma.measurement") / "jigs" / f"{name}.yaml").read_text(
                encoding="utf-8"
            )
            return parse_yaml(text, JigDocument, MeasurementError, source=f"jigs/{name}.yaml").to_jig()
        if Path(name).suffix.lower() in (".yaml", ".yml"):
            return read_yaml(name, JigDocument, MeasurementError).to_jig()
        raise MeasurementError(
            option="jig",
            expected="a jig of the catalogue or a .yaml file",
            value=name,
            remedy=choice_remedy(name, catalogue()),
        )

    @property
    def face_count(self) -> int:
        """Number of faces that may be touched."""
        return len(self.block)

    @property
    def face_names(self) -> tuple[str, ...]:
        """Name of every face, such as "low/+z"."""
        sides = zip(self.block.tolist(), self.sign.tolist(), self.axis.tolist(), strict=True)
        return tuple(
            f"{self.block_names[b]}/{'+' if sign > 0 else '-'}{'xyz'[axis]}" for b, sign, axis in sides
        )

    @property
    def coordinate(self) -> Float64[Tensor, " faces"]:
        """Coordinate of every face along its axis [m]."""
        side = torch.where(self.sign[:, None] > 0, self.upper[self.block], self.lower[self.block])
        return side.take_along_dim(self.axis[:, None], 1)[:, 0]

    @property
    def outward(self) -> Float64[Tensor, "faces 3"]:
        """Outward unit normal of every face."""
        return torch.nn.functional.one_hot(self.axis, 3) * self.sign[:, None]

    @property
    def extent(self) -> tuple[Float64[Tensor, "faces 3"], Float64[Tensor, "faces 3"]]:
        """Smallest and largest coordinates on every face [m]; along the normal, both are `coordinate`."""
        along = torch.nn.functional.one_hot(self.axis, 3).bool()
        coordinate = self.coordinate[:, None]
        return (
            torch.where(along, coordinate, self.lower[self.block]),
            torch.where(along, coordinate, self.upper[self.block]),
        )

    def is_on_face(
        self, face: Int64[Tensor, "*batch"], point: Float64[Tensor, "*batch 3"], margin: float = 0.0
    ) -> Bool[Tensor, "*batch"]:
        """Return whether points are on a face, away from its edges and not covered by another block.

        Args:
            face: index of the face.
            point: points in the frame of the jig [m]; the coordinate along the face's normal is ignored.
            margin: smallest distance [m] from the edges and from other blocks on the face.
        """
        lower, upper = (bound[face] for bound in self.extent)
        along = torch.nn.functional.one_hot(self.axis[face], 3).bool()
        on_plane = torch.where(along, lower, point)
        inside = ((on_plane >= lower + margin) & (on_plane <= upper - margin) | along).all(-1)
        just_outside = on_plane + 2 * _SKIN * self.outward[face]
        grown = torch.where(along, 0.0, margin)[..., None, :]
        others = (just_outside[..., None, :] > self.lower - grown - _SKIN) & (
            just_outside[..., None, :] < self.upper + grown + _SKIN
        )
        return inside & ~others.all(-1).any(-1)

    def intersects_line(
        self, start: Float64[Tensor, "*batch 3"], end: Float64[Tensor, "*batch 3"]
    ) -> Bool[Tensor, "*batch"]:
        """Return whether the straight line from `start` to `end` [m] intersects a block.

        Source: the slab method of Kay and Kajiya 1986, "Ray tracing complex scenes".
        """
        step = (end - start)[..., None, :]
        parallel = step.abs() < 1e-15
        safe = torch.where(parallel, 1.0, step)
        near = (self.lower + _SKIN - start[..., None, :]) / safe
        far = (self.upper - _SKIN - start[..., None, :]) / safe
        enter, leave = torch.minimum(near, far), torch.maximum(near, far)
        within = (start[..., None, :] > self.lower + _SKIN) & (start[..., None, :] < self.upper - _SKIN)
        enter = torch.where(parallel, torch.where(within, -torch.inf, torch.inf), enter)
        leave = torch.where(parallel, torch.where(within, torch.inf, -torch.inf), leave)
        return (enter.amax(-1).clamp(min=0) < leave.amin(-1).clamp(max=1)).any(-1)

    def check_overlaps(self) -> None:
        """Refuse blocks that overlap.

        Raises:
            ValueError: two blocks overlap.
        """
        common = torch.minimum(self.upper[:, None], self.upper) - torch.maximum(
            self.lower[:, None], self.lower
        )
        overlap = (common > _SKIN).all(-1).triu(1)
        if overlap.any():
            a, b = (self.block_names[number] for number in overlap.nonzero()[0].tolist())
            raise ValueError(f"the blocks '{a}' and '{b}' overlap; correct corner_mm or size_mm")

    def check_faces(self) -> None:
        """Refuse faces that cannot be touched.

        Raises:
            ValueError: a face is completely covered by another block.
        """
        lower, upper = self.extent
        outside = 2 * _SKIN * self.outward
        covered = (
            ((lower + outside)[:, None] > self.lower - _SKIN)
            & ((upper + outside)[:, None] < self.upper + _SKIN)
        ).all(-1)
        if covered.any():
            face, block = covered.nonzero()[0].tolist()
            raise ValueError(
                f"the face {self.face_names[face].rpartition('/')[2]} of block "
                f"'{self.block_names[int(self.block[face])]}' is covered by block '{self.block_names[block]}'; remove "
                "it from 'faces'"
            )


def catalogue() -> tuple[str, ...]:
    """Return the sorted names of the jigs that come with pisigma."""
    folder = resources.files("pisigma.measurement") / "jigs"
    return tuple(
        sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml"))
    )
