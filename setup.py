"""What the wheel holds: the package, and `robots/` and `data/`, which stand beside it here and inside it there."""

from setuptools import find_packages, setup

SHIPPED = {f"forgetmimic_jax.shipped.{folder}": folder for folder in ("robots", "data")}

setup(
    packages=[*find_packages(include=["forgetmimic_jax*"]), *SHIPPED],
    package_dir=SHIPPED,
    package_data={"": ["*.html"], **{package: ["**/*"] for package in SHIPPED}},
)
