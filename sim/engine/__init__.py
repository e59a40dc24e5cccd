"""Gateway to SAPIEN's physics; outside of it SAPIEN is imported only where pictures are drawn."""

import warnings

with warnings.catch_warnings():
    # Without a system Vulkan SAPIEN warns that it falls back to its own; nothing here renders.
    warnings.filterwarnings("ignore", message=".*libvulkan.*")
    warnings.filterwarnings("ignore", message=".*pkg_resources.*")
    import sapien  # noqa: F401
