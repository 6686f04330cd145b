"""Which packages there are: pyproject.toml cannot say that `conf/` is `safe_rl/conf` in a wheel."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["safe_rl", "safe_rl.*"]), "safe_rl.conf"],
    package_dir={"safe_rl.conf": "conf"},
)
