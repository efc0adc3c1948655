"""Robot descriptions, robot files, the catalogue, and kinematics with torch and in compiled kernels.

Names are loaded on first use, so that kernels do not import torch; `__init__.pyi` declares them to type checkers.
"""

from pisigma.files.lazy_names import lazy_getattr

__getattr__ = lazy_getattr(
    __name__,
    {
        "description": "Robot",
        "robot_file": "RobotDocument catalogue",
        "row": "DH_COLUMNS FRAME_COLUMNS JointType Row",
    },
)
