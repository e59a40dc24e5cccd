"""Versions of the packages that results depend on."""

from __future__ import annotations

import platform
from collections.abc import Iterable

PACKAGES = ("batchpid", "numpy", "sapien", "jax", "h5py", "cmaes", "mujoco", "gymnasium")
"""Packages on which a result may depend."""


def package_versions(packages: Iterable[str] = PACKAGES) -> dict[str, str]:
    """Return the versions of Python and of the installed ``packages``, by name; for batchpid, its
    ``__version__``.
    """
    from importlib.metadata import PackageNotFoundError, version  # slow to import

    import batchpid

    versions = {"python": platform.python_version()}
    for package in packages:
        try:
            if package == "batchpid":
                versions[package] = batchpid.__version__
            else:
                versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions
