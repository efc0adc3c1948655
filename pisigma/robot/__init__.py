"""What a robot is: its description, its file and the catalogue; where it goes: kinematics and kernels.

Names are loaded on first use, so that kernels are without torch; `__init__.pyi` tells them to type checkers.
"""

from pisigma.files.lazy_names import lazily

__getattr__ = lazily(
    __name__,
    {
        "description": "Robot",
        "robot_file": "RobotDocument catalogue",
        "row": "DH_COLUMNS FRAME_COLUMNS JointType Row",
    },
)
