"""Options of a Ray cluster that runs the workers of a runner."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

from batchpid.arrays.array_types import Document
from batchpid.checks.validate import instance, integer
from batchpid.errors import InvalidArgumentError


@dataclass(frozen=True, eq=False)
class Ray:
    """Ray cluster, for the option ``cluster`` of :class:`batchpid.sim.Runner`; ``"ray"`` means
    ``Ray()``.

    Raises
    ------
    InvalidArgumentError
        An option is out of range.
    """

    address: str | None = None
    """Address of the cluster, "HOST:PORT" as ``ray start`` prints it, or "local" for a new one of
    this machine alone, which ends with this process. Default: the environment variable RAY_ADDRESS,
    else a cluster that runs on this machine, else "local".
    """
    _: KW_ONLY
    nodes: int | None = None
    """Largest number of machines. Default: all that have enough CPUs."""
    cpus_per_node: int | None = None
    """Workers on each machine, each on one CPU of Ray's count. Machines with fewer CPUs are not
    used. Default: all CPUs that Ray counts.
    """
    runtime_env: Document | None = None
    """Ray's ``runtime_env`` of the processes on the machines, such as ``{"working_dir": "."}``."""

    def __post_init__(self) -> None:
        if self.address is not None and (
            not isinstance(self.address, str) or "://" in self.address
        ):
            raise InvalidArgumentError(
                "address",
                "must be HOST:PORT, 'auto' or 'local'",
                value=self.address,
                remedy=(
                    "pass the address that ray start printed, on a machine that belongs to the"
                    " cluster"
                ),
            )
        for name in ("nodes", "cpus_per_node"):
            if getattr(self, name) is not None:
                integer(name, getattr(self, name), 1, 100_000)
        if self.runtime_env is not None:
            instance("runtime_env", self.runtime_env, dict, "pass a dict as for ray.init")
