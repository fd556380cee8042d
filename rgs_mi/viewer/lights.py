"""The environments that a window offers: the scene's own, those of the suite, and files that were named at the start."""

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..export.relight import load_envmap
from ..shading import prefilter
from ..shading.environment import Environment, FilteredEnvironment
from ..targets.environments import ENVIRONMENTS
from .look import OWN


class Lights:
    """Environments by name, in the orientation of the scene's ``own``, each filtered the first time that someone asks for it.

    ``names``: what can be chosen, and nothing else can be. A filter's operator takes seconds, and is computed in another thread
    meanwhile; all else is done by the caller.
    Raises: UserError for a file that can't be read.
    """

    def __init__(self, own: Environment, files: Iterable[str | Path] = ()) -> None:
        self._own = own
        self._files = {str(path): Environment.from_emitter(load_envmap(path)) for path in files}
        self.names = (OWN, *self._files, *sorted(ENVIRONMENTS))
        self._filtered: dict[str, FilteredEnvironment] = {}
        self._filters = ThreadPoolExecutor(1, "filter")
        self._operators: dict[tuple[int, int], Future] = {}  # by size, those that were asked for

    @property
    def rotation(self) -> np.ndarray:
        """The rotation [3, 3] of all of them, to world space; their up axis is y."""
        return self._own.rotation

    def __getitem__(self, name: str) -> FilteredEnvironment:
        """The environment ``name``; waits where it was not `prepared`."""
        if name not in self._filtered:
            environment = self._environment(name)
            if environment.size in self._operators:
                self._operators[environment.size].result()
            self._filtered[name] = environment.filtered()
        return self._filtered[name]

    def prepare(self, name: str, ready: Callable[[], None] = lambda: None) -> None:
        """Call ``ready()``, perhaps from another thread, once ``name`` is there without waiting."""
        if name in self._filtered:
            return ready()
        size = self._environment(name).size
        if size not in self._operators:
            self._operators[size] = self._filters.submit(prefilter.prefilter, *size, mi.variant())
        self._operators[size].add_done_callback(lambda _: ready())

    def set_own(self, own: FilteredEnvironment) -> None:
        """Put another light in place of the scene's own: that which a fit has found by now."""
        self._own, self._filtered[OWN] = own.environment, own

    def close(self) -> None:
        """End the thread."""
        self._filters.shutdown(wait=False, cancel_futures=True)

    def _environment(self, name):
        if name == OWN:
            return self._own
        if name not in self._files:
            self._files[name] = Environment.from_emitter(load_envmap(name))
        return replace(self._files[name], rotation=self._own.rotation)
