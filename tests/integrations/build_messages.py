"""Build the messages of `moveit_msgs/GetPositionIK` that the node uses, as there are no wheels of moveit_msgs.

Run `ROS/bin/python tests/integrations/build_messages.py` with the Python of an environment that has the wheels of
`tests/integrations/requirements.txt`. The messages have only the fields that the node reads or writes, and constraints
are texts, so that they do not communicate with MoveIt: they are for tests.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

CODES = {
    "SUCCESS": 1,
    "FAILURE": 99999,
    "INVALID_GOAL_CONSTRAINTS": -16,
    "INVALID_LINK_NAME": -18,
    "FRAME_TRANSFORM_FAILURE": -21,
    "COLLISION_CHECKING_UNAVAILABLE": -22,
    "COMMUNICATION_FAILURE": -25,
    "NO_IK_SOLUTION": -31,
}
CONSTRAINTS = ("joint", "position", "orientation", "visibility")
INTERFACES = {
    "msg/MoveItErrorCodes.msg": ["int32 val", *(f"int32 {name}={value}" for name, value in CODES.items())],
    "msg/RobotState.msg": ["sensor_msgs/JointState joint_state"],
    "msg/Constraints.msg": [f"string[] {kind}_constraints" for kind in CONSTRAINTS],
    "msg/PositionIKRequest.msg": [
        "Constraints constraints",
        "geometry_msgs/PoseStamped[] pose_stamped_vector",
        "RobotState robot_state",
        "bool avoid_collisions",
        "string ik_link_name",
        "geometry_msgs/PoseStamped pose_stamped",
    ],
    "srv/GetPositionIK.srv": [
        "PositionIKRequest ik_request",
        "---",
        "RobotState solution",
        "MoveItErrorCodes error_code",
    ],
}
CMAKE = """cmake_minimum_required(VERSION 3.20)
project(moveit_msgs)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(sensor_msgs REQUIRED)
foreach(one builtin_interfaces geometry_msgs sensor_msgs service_msgs std_msgs)
  # the wheels export the folder of Python.h on the machine that built them
  set_target_properties(${{one}}::${{one}}__rosidl_generator_py PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "")
endforeach()
rosidl_generate_interfaces(${{PROJECT_NAME}} {files} DEPENDENCIES geometry_msgs sensor_msgs)
ament_package()
"""
PACKAGE = """<package format="3">
  <name>moveit_msgs</name><version>0.0.0</version><description>Fields for tests.</description>
  <maintainer email="pisigma@example.org">The pisigma developers</maintainer><license>MIT</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>geometry_msgs</depend><depend>sensor_msgs</depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""


def main() -> None:
    """Generate, compile and install the messages into this environment."""
    prefix = Path(sys.prefix)
    environment = os.environ | {
        "PATH": f"{prefix / 'bin'}:{os.environ['PATH']}",
        "LD_LIBRARY_PATH": str(prefix / "lib"),
        "AMENT_PREFIX_PATH": str(prefix),
    }
    with tempfile.TemporaryDirectory() as folder:
        source, build = Path(folder) / "moveit_msgs", Path(folder) / "build"
        for name, lines in INTERFACES.items():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_text("\n".join(lines) + "\n")
        (source / "package.xml").write_text(PACKAGE)
        (source / "CMakeLists.txt").write_text(
            CMAKE.format(files=" ".join(f'"{name}"' for name in INTERFACES))
        )
        paths = f"-DCMAKE_PREFIX_PATH={prefix}", f"-DCMAKE_INSTALL_PREFIX={prefix}"
        python = f"-DPython3_EXECUTABLE={sys.executable}"
        for words in (
            ["cmake", "-S", source, "-B", build, "-DBUILD_TESTING=OFF", *paths, python],
            ["cmake", "--build", build, "--target", "install", "--parallel", "2"],
        ):
            subprocess.run([str(word) for word in words], env=environment, check=True)


if __name__ == "__main__":
    main()
