"""The package for colcon."""

from setuptools import setup

setup(
    name="pisigma_ros",
    version="0.2.0",
    packages=["pisigma_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pisigma_ros"]),
        ("share/pisigma_ros", ["package.xml"]),
        ("share/pisigma_ros/launch", ["launch/corrected_ik.launch.py"]),
    ],
    install_requires=["setuptools"],
    entry_points={
        "console_scripts": [
            "corrected_ik = pisigma_ros.node:main",
            "record_session = pisigma_ros.recorder:main",
        ]
    },
)
