"""The environment's maps along a fit: filtered once for several steps, whose gradients reach the environment together."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import as_float
from ..shading.environment import FilteredEnvironment
from .model import ENVIRONMENT, Model

#: Steps from one filtering to the next. An environment changes slowly, and filtering it is no work for threads.
STEPS = 4
_GATHERED = "light_gradient"  # its name in a checkpoint


class LightMaps:
    """What `Environment.filtered`, or `unfiltered`, gave of a ``model``'s environment at most `STEPS` steps ago."""

    def __init__(self) -> None:
        self._maps: FilteredEnvironment | None = None
        self._of: tuple | None = None  # the parameter that was filtered, and whether it was
        self._gradient: mi.Float | None = None

    def see(self, model: Model, filtered: bool) -> FilteredEnvironment:
        """Return the environment as a step has it, ``filtered`` or as it is."""
        environment, parameter = model.environment(), model[ENVIRONMENT]
        if self._of is None or self._of[1] != filtered or self._of[0].shape != parameter.shape:
            self._maps = environment.filtered() if filtered else environment.unfiltered()
            self._of = parameter, filtered
            if self._gradient is not None and dr.width(self._gradient) != dr.width(self._maps.texels):
                self._gradient = None  # in maps of another size
        assert self._maps is not None
        return replace(self._maps, environment=environment)

    def state(self) -> dict[str, np.ndarray]:
        """For a checkpoint: what has been gathered, which `restore` takes back; of several processes by the one that saves."""
        return {} if self._gradient is None else {_GATHERED: self._gradient.numpy()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from the `state` among ``arrays``, of which the model's has been restored."""
        self._maps, self._of = None, None
        self._gradient = as_float(arrays[_GATHERED]) if _GATHERED in arrays else None

    def gather(self, step: int, gradient: "mi.Float") -> "mi.Float | None":
        """Take the ``gradient`` of step number ``step`` in the maps that it has seen. The last of `STEPS` returns the sum, which
        `pass_on` is to take."""
        gradient = gradient if self._gradient is None else self._gradient + gradient
        self._gradient = None if (step + 1) % STEPS == 0 else gradient
        dr.eval(self._gradient)
        return gradient if self._gradient is None else None

    def pass_on(self, model: Model, gradient: "mi.Float") -> None:
        """Pass ``gradient``, in the maps that were seen, on to the ``model``'s environment, which is filtered again for the next
        step."""
        assert self._maps is not None and self._of is not None, "see() comes first"
        dr.set_grad(self._maps.texels, gradient)
        dr.enqueue(dr.ADMode.Backward, self._maps.texels)
        dr.traverse(dr.ADMode.Backward)
        parameter = model[ENVIRONMENT]
        if parameter.array.index_ad != self._of[0].array.index_ad:
            dr.accum_grad(parameter, dr.grad(self._of[0]))
        self._maps = self._of = None
