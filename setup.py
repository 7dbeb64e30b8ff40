"""The rooms stand at the root of the repository and are installed as thermogrip.ROOM."""

from setuptools import find_packages, setup

ROOMS = ("datasets", "sysid", "mpc", "rig", "classify")

setup(
    packages=[
        *find_packages("src"),
        *(f"thermogrip.{name}" for name in find_packages(include=[f"{room}*" for room in ROOMS])),
    ],
    package_dir={"": "src", **{f"thermogrip.{room}": room for room in ROOMS}},
)
