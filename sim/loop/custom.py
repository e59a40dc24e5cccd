"""Control by the caller's own controller, called at every sim step with the state of a group of
envs.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Document, Rows
from batchpid.arrays.elementwise import namespace, precision, read_only
from batchpid.arrays.trees import flatten, unflatten
from batchpid.errors import ControllerError, InvalidArgumentError
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.tool_space import OperationalSpace


class OwnController:
    """Caller's own controller (:class:`batchpid.sim.Controller`), checked; its state is a
    dictionary of arrays by name.

    All groups of envs share it, and thus its JAX program.
    """

    def __init__(self, options: RunnerOptions) -> None:
        assert not isinstance(options.control, str)
        self._options = options
        self._controller = options.control
        self.name = type(options.control).__name__
        if isinstance(options.control, OperationalSpace):
            self._reporting = options.control.reporting
            self.implicit = options.control.params.discretization is not None
        else:
            self._reporting = None
            self.implicit = False
        self._structure: Any = None

    def init(self, envs: int) -> dict[str, Rows]:
        """Return a checked copy of the controller's initial state for ``envs`` envs.

        Raises InvalidArgumentError if an array of the state does not have the envs as its first
        axis; at a later start ControllerError if the controller fails, or its state has other
        arrays than the first.
        """
        if self._structure is None:
            self._first = self._begun(envs)
            return self._first
        with controller_errors(self):
            like = {name: leaf[:1].repeat(envs, 0) for name, leaf in self._first.items()}
            return _like(like, self._begun(envs))

    def _begun(self, envs: int) -> dict[str, Rows]:
        # The structure stays the same; between sim steps only its arrays are kept, by name.
        state = self._structure = _begin(self._options, envs)
        leaves = {name: np.array(leaf) for name, leaf in flatten(state).items()}
        for name, leaf in leaves.items():
            if leaf.shape[:1] != (envs,):
                raise InvalidArgumentError(
                    "control",
                    f"init returned a state{name and ' ' + name} of shape {leaf.shape}, for {envs}"
                    " envs",
                    remedy="make the envs the first axis of every array of the state",
                )
        return leaves

    def __call__(self, state: Document, *inputs: Array) -> tuple[Array, ...]:
        """Return the new state and the effort (M, dof); inputs are setpoint, qpos, qvel, passive
        force, and the time to the end of the tick, which only operational-space control takes.

        Operational-space control limits efforts itself; a third result are the joints with limited
        efforts (M, dof).

        Raises InvalidArgumentError if the controller returned an effort or a state of a wrong shape
        or dtype, or JAX cannot trace it.
        """
        if namespace(*inputs[1:3]) is not np:
            return self._traced(state, *inputs)
        # The controller may keep them, but not write to them.
        copies = (read_only(np.array(rows)) for rows in inputs)
        new, returned, *limited = self._called(unflatten(self._structure, state), *copies)
        # Copies again: the controller may change its own arrays at any time.
        leaves = _like(state, flatten(new, read=np.array))
        effort = _like({"effort": inputs[1]}, {"effort": np.array(returned, np.float64)})["effort"]
        return leaves, effort, *limited

    def _called(self, *arguments: Any) -> tuple[Array, ...]:
        if self._reporting is not None:
            return self._reporting(*arguments)
        state, effort = self._controller(*arguments[:-1])
        return state, effort

    def _traced(self, leaves: Document, *inputs: Array) -> tuple[Array, ...]:
        """Call the controller within a JAX program."""
        import jax

        qpos = inputs[1]
        try:
            state, returned, *limited = self._called(unflatten(self._structure, leaves), *inputs)
            new = _like(leaves, flatten(state, read=jax.numpy.asarray))
            efforts = {"effort": jax.numpy.asarray(returned, qpos.dtype)}
        except (TypeError, jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
            raise InvalidArgumentError(
                "control",
                f"cannot be traced by JAX: {str(error).splitlines()[0]}",
                remedy="write it in jax.numpy, or use backend='numpy'",
            ) from error
        return new, _like({"effort": qpos}, efforts)["effort"], *limited


@contextmanager
def controller_errors(controller: OwnController | None, step: int = 0) -> Iterator[None]:
    """Convert errors in sim step ``step`` of a tick to ControllerErrors, unless ``controller`` is
    None.
    """
    try:
        yield
    except Exception as error:
        if controller is None:
            raise
        raise ControllerError(controller.name, error, step) from error


def _begin(options: RunnerOptions, envs: int) -> Any:
    """Return the initial state of the caller's own controller for ``envs`` envs."""
    assert not isinstance(options.control, str)
    init: Callable[..., Any] = options.control.init
    arguments: tuple[Any, ...] = (options.robot, envs, options.timestep)
    # A controller without a time step of its own may leave the last argument out.
    try:
        inspect.signature(init).bind(*arguments)
    except TypeError:
        arguments = arguments[:2]
    if options.backend != "jax":
        return init(*arguments)
    # Its arrays have this dtype, not JAX's default in this process.
    with precision("float64"):
        state = init(*arguments)
        return unflatten(state, flatten(state))


def _like(before: Document, leaves: Document) -> Document:
    """Return the arrays that a controller returned in the dtypes of ``before``.

    Raises InvalidArgumentError if names or shapes differ, or a dtype cannot be cast.
    """
    for name in {**before, **leaves}:
        old: Any = before.get(name)
        new: Any = leaves.get(name)
        is_fit = old is not None and new is not None and new.shape == old.shape
        if is_fit and np.can_cast(new.dtype, old.dtype, "same_kind"):
            continue
        # Without the number of envs, which is that of a group.
        returned = "no array" if new is None else f"{new.dtype} {new.shape[1:]} per env"
        raise InvalidArgumentError(
            "control",
            f"returned {name!r} of {returned}",
            remedy="return (state, effort): a state as init does, an effort of shape (envs, dof)",
        )
    return {name: leaf.astype(before[name].dtype, copy=False) for name, leaf in leaves.items()}
