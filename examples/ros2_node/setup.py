"""An ament_python package; `hno-runtime` or `hno` must be importable where the node runs."""

from setuptools import setup

NAME = "hno_controller"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/players.launch.py"]),
    ],
    install_requires=["setuptools"],
    maintainer="the hno developers",
    maintainer_email="hno@example.org",
    description="Plays one player, or all, of a differential game with a controller that hno has exported.",
    license="MIT",
    entry_points={"console_scripts": [f"controller = {NAME}.node:main"]},
)
