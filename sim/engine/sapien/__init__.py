"""SAPIEN: packs of scenes, dynamics, contacts. No other folder imports SAPIEN."""

import warnings

with warnings.catch_warnings():
    # Before the modules of this folder import it: without a system Vulkan SAPIEN warns that it falls
    # back to its own, but nothing here renders.
    warnings.filterwarnings("ignore", message=".*libvulkan.*")
    warnings.filterwarnings("ignore", message=".*pkg_resources.*")
    import sapien  # noqa: F401
