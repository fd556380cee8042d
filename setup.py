"""What pyproject.toml can't say: two folders of the package lie beside it."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["rgs_mi", "rgs_mi.*"]), "rgs_mi.plugins", "rgs_mi.scenes"],
    package_dir={"rgs_mi.plugins": "plugins", "rgs_mi.scenes": "scenes"},
)
