"""Options of a Ray cluster that runs the workers of a runner."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Literal, get_args

from batchpid.arrays.array_types import Document
from batchpid.checks.validate import choice, flag, instance, integer
from batchpid.errors import InvalidArgumentError

Placement = Literal["SPREAD", "PACK"]


@dataclass(frozen=True, eq=False)
class Ray:
    """Ray cluster, for the option ``cluster`` of :class:`batchpid.sim.Runner`; ``"ray"`` means ``Ray()``.

    Raises
    ------
    InvalidArgumentError
        An option is out of range.
    """

    address: str | None = None
    """Address of the cluster, "HOST:PORT" as ``ray start`` prints it, or "local" for a new one of this machine alone,
    which ends with this process. Default: the environment variable RAY_ADDRESS, else a cluster that runs on this
    machine, else "local"."""
    _: KW_ONLY
    nodes: int | None = None
    """Largest number of machines. Default: all that have enough CPUs."""
    cpus_per_node: int | None = None
    """Workers on each machine, each on one CPU of Ray's count. Machines with fewer CPUs are not used. Default: all
    CPUs that Ray counts."""
    placement: Placement = "SPREAD"
    """``"SPREAD"`` the envs over all machines, in proportion to their workers; ``"PACK"`` them on the fewest machines
    that have a worker for every env."""
    accept_differences: bool = False
    """Accept machines whose processors or libraries round differently, with a warning. Results then depend on the
    machine that runs an env."""
    runtime_env: Document | None = None
    """Ray's ``runtime_env`` of the processes on the machines, such as ``{"working_dir": "."}``."""

    def __post_init__(self) -> None:
        if self.address is not None and (not isinstance(self.address, str) or "://" in self.address):
            raise InvalidArgumentError(
                "address",
                "must be HOST:PORT, 'auto' or 'local'",
                value=self.address,
                remedy="pass the address that ray start printed, on a machine that belongs to the cluster",
            )
        for name in ("nodes", "cpus_per_node"):
            if getattr(self, name) is not None:
                integer(name, getattr(self, name), 1, 100_000)
        choice("placement", self.placement, get_args(Placement))
        flag("accept_differences", self.accept_differences)
        if self.runtime_env is not None:
            instance("runtime_env", self.runtime_env, dict, "pass a dict as for ray.init")


class ClusterWarning(UserWarning):
    """A cluster is slow, or its machines may compute different results."""
