"""The gateway to SAPIEN's physics; no other room but the renderer imports SAPIEN."""

import warnings

with warnings.catch_warnings():
    # Without a system Vulkan SAPIEN warns that it falls back to its own; nothing here renders.
    warnings.filterwarnings("ignore", message=".*libvulkan.*")
    warnings.filterwarnings("ignore", message=".*pkg_resources.*")
    import sapien  # noqa: F401
