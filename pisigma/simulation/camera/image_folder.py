"""Rendered images as files, with what a real cell would state beside them."""

import os

from PIL import Image

from pisigma.files.output_folder import staged_folder
from pisigma.files.yaml_file import yaml_text
from pisigma.simulation.camera.simulated_images import SimulatedImages
from pisigma.simulation.true_robot import TrueRobot

STATED = ("joints.csv", "camera.yaml", "board.yaml")


def write_images(images: SimulatedImages, robot: TrueRobot, folder: str | os.PathLike[str]) -> int:
    """Render images as `0000.png` and so on, beside `joints.csv`, `camera.yaml` and `board.yaml` as stated.

    Args:
        images: of a recipe.
        robot: true robot.
        folder: to write, whole or not at all; it does not exist or is empty.

    Returns:
        The number of images.

    Raises:
        RecipeError: the robot does not reach the views.
        OutputError: the folder exists, or cannot be written.
    """
    axes = robot.nominal.axes
    names = [f"q{joint + 1}_{axis.file_unit}" for joint, axis in enumerate(axes)]
    lines = [",".join(("image", *names))]
    files = [f"{number:04d}.png" for number in range(images.poses.count)]
    with staged_folder(folder, names=(*files, *STATED)) as scratch:
        q = robot.nominal.to_controller(images.joints_read(robot)).numpy()
        for file, joints, image in zip(files, q, images.rendered(robot), strict=True):
            Image.fromarray(image).save(scratch / file)
            shown = (axis.in_file_unit(float(value)) for axis, value in zip(axes, joints, strict=True))
            lines.append(",".join((file, *(f"{value:.9f}" for value in shown))))
        (scratch / STATED[0]).write_text("\n".join(lines) + "\n", encoding="utf-8")
        for document, name in zip((images.camera, images.board), STATED[1:], strict=True):
            stated = document.model_dump(mode="json", exclude_unset=True)
            (scratch / name).write_text(yaml_text(stated), encoding="utf-8")
    return len(q)
